"""Receiver of an edge's blocks. It reads them from the stream and requests missing ones, as a worker does."""

import asyncio
import contextlib
from typing import Self

import nats
import numpy as np
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, decode
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.process.runtime import end_tasks
from tests.fleet.nats_cluster import connected
from tests.patience import LONG_S

POLL_S = 0.01
"""Poll interval of the stream [s]."""
REQUEST_EVERY = 5
"""Number of blocks after a missing one at which the missing block is requested again."""
CONFIRM_EVERY = 10
"""Number of accepted blocks after which they are confirmed."""


class Receiver:
    """Reader of the blocks of one pack. It accepts them in the order of their numbers and requests missing ones.

    Args:
        url: URL of the server.
        pack: Name of the pack.

    Attributes:
        dropped_once: Numbers of blocks whose first arrival is dropped.
        blocks: Accepted blocks.
        resends: Number of blocks that arrived again after they had been accepted.
        gaps: Number of blocks that arrived while an earlier one was missing.
    """

    def __init__(self, url: str, pack: str) -> None:
        self._url, self.pack = url, pack
        self._store, self._next = 0, 1
        self._requested = 0
        self.blocks: list[Block] = []
        self.dropped_once: set[int] = set()
        self.resends = self.gaps = 0

    async def __aenter__(self) -> Self:
        self.nc = await connected(self._url)
        await make_streams(self.nc, partitions=4)
        self._task = asyncio.create_task(self._read())
        return self

    async def __aexit__(self, *_: object) -> None:
        await end_tasks(self._task)
        await self.nc.close()

    @property
    def samples(self) -> SampleBlock:
        """Return the samples with their times since 1970."""
        blocks = []
        for block in self.blocks:
            samples = block.samples.copy()
            samples["time_s"] += block.store_created_ns / 1e9  # the store's creation time [ns since 1970]
            blocks.append(samples)
        return np.concatenate(blocks)

    async def wait_for_samples(self, count: int) -> None:
        """Wait until ``count`` samples have been accepted."""
        async with asyncio.timeout(LONG_S):
            while sum(block.samples.size for block in self.blocks) < count:
                if self._task.done():
                    self._task.result()
                await asyncio.sleep(POLL_S)

    async def reply(self, request: BlockRequest | bytes) -> None:
        """Send a request to the edge, as a worker does."""
        payload = request if isinstance(request, bytes) else request.model_dump_json().encode()
        await self.nc.publish(subjects.block_request(self.pack), payload)
        await self.nc.flush()

    async def _read(self) -> None:
        js, sequence = self.nc.jetstream(timeout=1.0), 1  # the stream's sequence numbers begin with 1
        while True:
            with contextlib.suppress(nats.errors.Error, asyncio.TimeoutError):  # the tests kill the server
                state = (await js.stream_info(subjects.RAW_STREAM)).state
                while sequence <= state.last_seq:
                    with contextlib.suppress(NotFoundError):
                        message = await js.get_msg(subjects.RAW_STREAM, sequence)
                        if str(message.subject).endswith(f".raw.{self.pack}"):
                            await self._process(decode(message.data or b""))
                    sequence += 1
            await asyncio.sleep(POLL_S)

    async def _process(self, block: Block) -> None:
        if block.store_created_ns < self._store or block.number in self.dropped_once:
            self.dropped_once.discard(block.number)
            return
        if block.store_created_ns > self._store:
            self._store, self._next = block.store_created_ns, block.oldest
        if block.number < self._next:
            self.resends += 1
        elif block.number > self._next:
            self.gaps += 1
            if self._requested != self._next or self.gaps % REQUEST_EVERY == 0:
                self._requested = self._next
                await self.reply(BlockRequest(store=self._store, number=self._next, resend=True))
        else:
            self._next += 1
            self.blocks.append(block)
            if (self._next - 1) % CONFIRM_EVERY == 1:
                await self.reply(BlockRequest(store=self._store, number=self._next, resend=False))
