"""Result of a message of the stream, and the reasons for dead letters."""

from typing import NamedTuple

from bms_estimator.edge.subjects import BlockRequest

LETHAL = "the workers that processed it have died"
"""Reason for the dead letter of a lethal block."""
INTERNAL_ERROR = "internal error; the log of the worker has the traceback"
"""Reason for the dead letter of a block that was skipped because of an internal error."""


class AlarmMessage(NamedTuple):
    """Message about an alarm or event of a pack."""

    topic: str
    payload: bytes


class HistoryMessage(NamedTuple):
    """Rows of a pack's history, or a request for a fit, which the server stores."""

    subject: str
    data: bytes
    message_id: str
    """Equal for all workers, so that the server drops repetitions."""


class BlockResult(NamedTuple):
    """Result of a message.

    Attributes:
        pack: Name of the pack.
        reply: Reply to the edge; None if no reply is due.
        state: Payload of topic ``state``; None without one.
        parameters: Payload of topic ``parameters``; None without one.
        cells: Payload of topic ``cells``; None without one.
        alarms: Changed alarms and events, oldest first; once an hour all raised and unwatched alarms.
        hours: Message ids and rows of finished hours. The message id of a row is equal for all workers, so that the server
            drops repeated rows.
        history: Messages of the pack's history.
        failed: Number of blocks that were skipped because of an internal error.
        dead_reason: Reason why the block becomes a dead letter; empty if it does not become one.
    """

    pack: str
    reply: BlockRequest | None = None
    state: bytes | None = None
    parameters: bytes | None = None
    cells: bytes | None = None
    alarms: tuple[AlarmMessage, ...] = ()
    hours: tuple[tuple[str, bytes], ...] = ()
    history: tuple[HistoryMessage, ...] = ()
    failed: int = 0
    dead_reason: str = ""
