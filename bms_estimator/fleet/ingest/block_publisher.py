"""Publisher of stored blocks to the stream ``RAW``: each block once, and again if a worker requests it."""

import asyncio
import contextlib
import math
from collections.abc import Sequence

import structlog
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.edge.block_store import RESEND_S
from bms_estimator.fleet.ingest.store_table import BlockPage, StoredBlock
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS, error_text
from bms_estimator.store.database import Database, StoreError

PAGE_BLOCKS = 500
"""Maximum number of blocks without an acknowledgment."""
ACK_TIMEOUT_S = 5.0
"""Timeout of the acknowledgments of a page [s]."""
RETRY_S = 1.0
"""Retry interval after an error of the server or the disk [s]."""

log = structlog.get_logger(__name__)


class BlockPublisher:
    """Publishes blocks in the order in which they were stored.

    Args:
        nc: Connection to the tenant's NATS account, which reconnects.
        database: Database with ``INGEST_TABLES``.
        sent: Id of the last block that the server has acknowledged.

    Attributes:
        sent: Id of the last acknowledged block. The caller sets it to 0 to send all blocks again.
        published: Number of acknowledged blocks since the start, with repetitions.
        resends: Number of accepted requests to send blocks again.
        idle: Set while the server has acknowledged all blocks in the database.
    """

    def __init__(self, nc: Client, database: Database, sent: int) -> None:
        self._database = database
        self._js = nc.jetstream(publish_async_max_pending=2 * PAGE_BLOCKS)
        self.sent, self.published, self.resends = sent, 0, 0
        self._stored = asyncio.Event()
        self.idle = asyncio.Event()
        self._requested: dict[str, int] = {}  # first block to send again, by pack
        self._last_resend: dict[str, tuple[int, float]] = {}  # first block and time, by pack
        self._trouble = ""

    def notify(self) -> None:
        """Wake up ``run`` after a change of the database."""
        self.idle.clear()
        self._stored.set()

    def request_resend(self, pack: str, number: int) -> None:
        """Let ``run`` send a block and all later blocks of a pack again, unless it was requested less than ``RESEND_S`` ago."""
        now_s = asyncio.get_running_loop().time()
        last_number, last_s = self._last_resend.get(pack, (0, -math.inf))
        if number == last_number and now_s - last_s < RESEND_S:
            return
        self._last_resend[pack] = number, now_s
        self._requested[pack] = number
        self.resends += 1
        self.notify()

    async def send_one_again(self, pack: str, number: int) -> None:
        """Send one block of a pack again at once. Errors are ignored, because the caller repeats the call."""
        with contextlib.suppress(*RETRYABLE_ERRORS, StoreError):
            page = await self._database.call(BlockPage(1, pack=pack, first=number))
            await self._publish([block for block in page if block.id <= self.sent])

    async def run(self) -> None:
        """Publish until cancelled."""
        while True:
            self._stored.clear()
            try:
                while await self._resend_requested() or await self._send_next():
                    pass
            except (*RETRYABLE_ERRORS, StoreError) as error:
                self._log_trouble(error_text(error))
                await asyncio.sleep(RETRY_S)
                continue
            self._trouble = ""
            if not self._stored.is_set():
                self.idle.set()
                await self._stored.wait()

    async def _send_next(self) -> bool:
        """Send the next page of blocks. Return False if all blocks were sent."""
        sent = self.sent
        page = await self._database.call(BlockPage(PAGE_BLOCKS, after_id=sent))
        await self._publish(page)
        if page and self.sent == sent:  # else the caller has reset ``sent``
            self.sent = page[-1].id
        return bool(page)

    async def _resend_requested(self) -> bool:
        """Send a page of requested blocks again. Return False if there are none."""
        for pack, number in self._requested.items():
            page = await self._database.call(BlockPage(PAGE_BLOCKS, pack=pack, first=number))
            sent = [block for block in page if block.id <= self.sent]
            await self._publish(sent)
            if self._requested[pack] != number:  # requested again meanwhile
                return True
            if len(sent) == PAGE_BLOCKS:
                self._requested[pack] = sent[-1].number + 1
            else:
                del self._requested[pack]
            return True
        return False

    async def _publish(self, blocks: Sequence[StoredBlock]) -> None:
        """Publish blocks, and wait until the stream has stored them.

        Raises:
            nats.errors.Error, TimeoutError: Not all of them are stored.
        """
        acks = []
        try:
            for block in blocks:
                acks.append(await self._js.publish_async(subjects.raw(block.pack), block.data))  # noqa: PERF401 - the acks must be cancelled after an error
            async with asyncio.timeout(ACK_TIMEOUT_S):
                await asyncio.gather(*acks)
        finally:
            for ack in acks:
                ack.cancel()
        self.published += len(blocks)

    def _log_trouble(self, reason: str) -> None:
        if reason != self._trouble:
            log.warning("blocks cannot be sent to the workers; they stay stored", reason=reason)
        self._trouble = reason
