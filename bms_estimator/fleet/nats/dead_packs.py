"""Packs with dead letters, for the page and ``fleet status``, read without the blocks of the dead letters."""

import contextlib
from typing import NamedTuple

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.dead_letters import REASON_HEADER

MAX_REASONS = 20
"""Maximum number of packs whose reason is read."""


class DeadPacks(NamedTuple):
    """Packs with dead letters in the stream ``DEAD``."""

    packs: int = 0
    """Number of packs."""
    reasons: tuple[tuple[str, str], ...] = ()
    """Names of the first packs, sorted, each with the reason of its last dead letter."""


class DeadPackReader:
    """Reader of the packs with dead letters, which reads the reasons only after a change of the stream.

    Args:
        nc: Connection to the tenant's NATS account.
    """

    def __init__(self, nc: Client) -> None:
        self._js = nc.jetstream()
        self._position = (0, 0)  # last sequence number and number of messages of the stream
        self._dead_packs = DeadPacks()

    async def read(self) -> DeadPacks:
        """Return the present packs with dead letters; none if the server does not have the stream.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        try:
            state = (await self._js.stream_info(subjects.DEAD_STREAM)).state
            position = (state.last_seq, state.messages)
            if position != self._position:
                self._dead_packs, self._position = await self._read(), position
        except NotFoundError:
            return DeadPacks()
        return self._dead_packs

    async def _read(self) -> DeadPacks:
        info = await self._js.stream_info(subjects.DEAD_STREAM, subjects_filter=subjects.dead())
        packs = sorted({subject.split(".")[1] for subject in info.state.subjects or ()})
        reasons = []
        for pack in packs[:MAX_REASONS]:
            with contextlib.suppress(NotFoundError):  # removed meanwhile
                letter = await self._js.get_last_msg(subjects.DEAD_STREAM, subjects.dead(pack))
                reasons.append((pack, (letter.headers or {}).get(REASON_HEADER, "")))
        return DeadPacks(len(packs), tuple(reasons))
