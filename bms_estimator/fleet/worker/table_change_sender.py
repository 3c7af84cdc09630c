"""Sending of changes of the table of packs to the stream of one partition (``packs.table_change``)."""

import asyncio
from collections.abc import Callable, Iterable
from functools import partial

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.retry import RETRY_S, Attempt


class TableChangeSender:
    """Sender of the rows that differ from the ones in force.

    Args:
        nc: Connection to the tenant's NATS account.
        owned_partition: Returns the partition; None while this worker does not own it.
        attempt: Runs an action and handles its errors.
    """

    def __init__(self, nc: Client, owned_partition: Callable[[], Partition | None], attempt: Attempt) -> None:
        self._nc, self._owned_partition, self._attempt = nc, owned_partition, attempt
        self._packs = set[str]()  # packs whose rows may differ from those in force
        self._replay_end = 0
        self._wake_up = asyncio.Event()

    def begin(self, packs: Iterable[str], replay_end: int) -> None:
        """Replace the packs to check after a takeover, because the former owner may not have sent the last changes.

        Args:
            packs: Names of all packs with rows in force.
            replay_end: Stream sequence number of the last message of the partition at the takeover. Nothing is sent before the
                replay has reached it, because the replay contains the changes that the former owner has sent.
        """
        self._packs, self._replay_end = set(packs), replay_end

    def add(self, pack: str) -> None:
        """Check the row of a pack, and send it if it differs from the one in force."""
        self._packs.add(pack)
        self.wake_up()

    def wake_up(self) -> None:
        """Continue if the replay has ended meanwhile."""
        self._wake_up.set()

    async def run(self) -> None:
        """Send changes until cancelled."""
        while True:
            self._wake_up.clear()
            while self._packs and (partition := self._owned_partition()) and partition.sequence >= self._replay_end:
                pack = next(iter(self._packs))
                if await self._attempt(partial(self._send, partition, pack)):
                    self._packs.discard(pack)
                else:
                    await asyncio.sleep(RETRY_S)
            await self._wake_up.wait()

    async def _send(self, partition: Partition, pack: str) -> None:
        """Send the row of a pack if it differs from the one in force."""
        change = partition.in_force.table_change(pack)
        if change is not None:
            await self._nc.jetstream().publish(subjects.table_change(pack), change)
