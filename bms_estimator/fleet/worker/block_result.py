"""Results of the messages of the stream, and their publication.

Estimates and replies are dropped without a connection, because later ones replace them. Hourly summaries, messages of histories
and dead letters are queued until the server acknowledges them.
"""

import asyncio
from collections import deque
from collections.abc import Mapping
from itertools import islice
from typing import NamedTuple

from nats.aio.client import Client
from nats.js.api import Header

from bms_estimator.edge import subjects
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.nats.dead_letters import DeadLetter

LETHAL = "the workers that processed it have died"
"""Reason for the dead letter of a lethal block."""
INTERNAL_ERROR = "internal error; the log of the worker has the traceback"
"""Reason for the dead letter of a block that was skipped because of an internal error."""


class AlarmMessage(NamedTuple):
    """Message about an alarm or event of a pack."""

    topic: str
    payload: bytes


class QueuedMessage(NamedTuple):
    """Hourly summary, rows of a pack's history, request for a fit, or dead letter, which the server must store."""

    subject: str
    data: bytes
    headers: Mapping[str, str]


def stored_once(subject: str, data: bytes, message_id: str) -> QueuedMessage:
    """Return a message whose id is equal for all workers, so that the server drops repetitions."""
    return QueuedMessage(subject, data, {Header.MSG_ID.value: message_id})


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
        is_deferred: True if the message was not processed, and stays in the stream until its pack is served.
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
    history: tuple[QueuedMessage, ...] = ()
    is_deferred: bool = False
    failed: int = 0
    dead_reason: str = ""


MAX_MERGED_ALARMS = 256
"""Maximum number of messages about alarms and events of a pack after a replay of the stream. The newest are published."""
MAX_PENDING = 128
"""Maximum number of published messages that wait for the server's acknowledgment."""


class ResultPublisher:
    """Publisher of the results of one partition.

    Args:
        nc: Connection to the tenant's NATS account.

    Attributes:
        waiting: Queued messages that the server has not acknowledged yet.
        added: Results to be published by ``publish_added``.
    """

    def __init__(self, nc: Client) -> None:
        self._nc = nc
        self.waiting: deque[QueuedMessage] = deque()
        self.added: list[BlockResult] = []
        self._send_lock = asyncio.Lock()

    def queue(self, result: BlockResult) -> None:
        """Queue the hourly summaries and the history messages of a result."""
        subject = subjects.hours(result.pack)
        self.waiting.extend(stored_once(subject, row, message_id) for message_id, row in result.hours)
        self.waiting.extend(result.history)

    def queue_dead_letter(self, letter: DeadLetter) -> None:
        """Queue a dead letter."""
        self.waiting.append(QueuedMessage(letter.subject, letter.data, letter.headers()))

    def clear(self) -> None:
        """Drop the queued messages."""
        self.waiting.clear()

    async def send_queued(self) -> None:
        """Publish the queued messages in their order, and await the server's acknowledgment.

        Raises:
            nats.errors.Error: Some were not acknowledged; they remain queued.
        """
        js = self._nc.jetstream()

        async with self._send_lock:
            while self.waiting:
                messages = list(islice(self.waiting, MAX_PENDING))
                outcomes = await asyncio.gather(
                    *(js.publish(each.subject, each.data, headers=dict(each.headers)) for each in messages),
                    return_exceptions=True,
                )
                failed = [outcome for outcome in outcomes if isinstance(outcome, BaseException)]
                pairs = zip(messages, outcomes, strict=True)
                stored = {id(each) for each, outcome in pairs if not isinstance(outcome, BaseException)}
                self.waiting = deque(each for each in self.waiting if id(each) not in stored)
                if failed:
                    raise failed[0]

    def add(self, result: BlockResult) -> None:
        """Add a result for ``publish_added``."""
        self.added.append(result)

    async def publish_added(self) -> None:
        """Publish the added results."""
        results, self.added = self.added, []
        for result in results:
            await self.publish(result)

    async def publish(self, result: BlockResult) -> None:
        """Publish reply and estimates of a result, unless the connection is interrupted."""
        if not self._nc.is_connected:
            return
        if result.reply is not None:
            await self._nc.publish(subjects.block_request(result.pack), result.reply.model_dump_json().encode())
        topics = ("state", result.state), ("parameters", result.parameters), ("cells", result.cells), *result.alarms
        for topic, payload in topics:
            if payload is not None:
                await self._nc.publish(subjects.published(result.pack, topic), payload)


def merge(before: BlockResult | None, result: BlockResult) -> BlockResult:
    """Merge two successive results of one pack: the newest reply and payloads, and all alarms and events."""
    if before is None:
        return result
    return result._replace(
        reply=result.reply or before.reply,
        state=result.state or before.state,
        parameters=result.parameters or before.parameters,
        cells=result.cells or before.cells,
        alarms=(before.alarms + result.alarms)[-MAX_MERGED_ALARMS:],
    )
