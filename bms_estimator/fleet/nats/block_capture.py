"""Capture of a pack's blocks from the stream, in order and without repetitions."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from nats.aio.client import Client

from bms_estimator.edge.block import EXTREMES, Block, BlockError, decode, peek_cells, peek_probes
from bms_estimator.edge.subjects import RAW_STREAM
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.model.arrays import SAMPLE, CellBlock, SampleBlock

MAX_CLOCK_LEAD_S = 3600.0
"""Maximum lead of an edge's clock over the server's clock [s]. A block may be stored this long before the time of its
samples."""

MIN_YIELDED_SAMPLES = 65_536
"""Minimum number of samples that are yielded at a time, except for the last ones."""


@dataclass
class BlockCapture:
    """Blocks of one pack, to be added in the order of the stream.

    An edge numbers the blocks of its store, a queue on its disk. After a newer store, blocks of an earlier store are skipped, as
    workers skip them.

    Args:
        since_s: Beginning of the time span [s since 1970].
        until_s: End of the time span [s since 1970].

    Attributes:
        damaged: Number of messages that cannot be decoded.
        repeated: Number of blocks that arrived more than once, or belong to an earlier store.
    """

    since_s: float = -np.inf
    until_s: float = np.inf
    damaged: int = 0
    repeated: int = 0
    _blocks: dict[tuple[int, int], bytes] = field(default_factory=dict)  # by creation time of the store and number
    _store: int = 0  # creation time of the newest store

    def add(self, data: bytes) -> None:
        """Add the next message of the pack."""
        try:
            block = decode(data)
        except BlockError:
            self.damaged += 1
            return
        key = (block.store_created_ns, block.number)
        if block.store_created_ns < self._store or key in self._blocks:
            self.repeated += 1
            return
        self._store = block.store_created_ns
        if _wall_s(block, -1) >= self.since_s and _wall_s(block, 0) < self.until_s:
            self._blocks[key] = data

    @property
    def blocks(self) -> int:
        """Number of blocks in the time span."""
        return len(self._blocks)

    @property
    def span_s(self) -> tuple[float, float]:
        """Wall clock of the first and the last sample [s since 1970]; NaN without a block."""
        if not self._blocks:
            return np.nan, np.nan
        ordered = sorted(self._blocks)
        first_s, last_s = _wall_s(self._block(ordered[0]), 0), _wall_s(self._block(ordered[-1]), -1)
        return max(first_s, self.since_s), min(last_s, self.until_s)

    @property
    def missing(self) -> list[tuple[int, int]]:
        """First and last number of each range of missing blocks within a store."""
        pairs = itertools.pairwise(sorted(self._blocks))
        return [
            (number + 1, next_number - 1)
            for (store, number), (next_store, next_number) in pairs
            if store == next_store and next_number > number + 1
        ]

    @property
    def cells(self) -> int:
        """Number of cells of the newest block with cell voltages; 0 without any."""
        counts = (peek_cells(self._blocks[key]) for key in sorted(self._blocks, reverse=True))
        return next(filter(None, counts), 0)

    @property
    def columns(self) -> list[str]:
        """Fields of the samples, without the extremes of the temperature probes if no block has them."""
        has_probes = any(map(peek_probes, self._blocks.values()))
        return [name for name in SAMPLE.names or () if has_probes or name not in EXTREMES]

    def samples(self) -> Iterator[SampleBlock]:
        """Yield all samples; ``samples_with_cells`` describes their times."""
        return (samples for samples, _ in self.samples_with_cells())

    def samples_with_cells(self) -> Iterator[tuple[SampleBlock, CellBlock]]:
        """Yield all samples and their cell voltages, shape (n, ``cells``); NaN for a block with another number of cells.

        ``time_s`` counts from the creation of the first store. Samples of a later store follow by the edge's wall clock,
        or immediately after the last sample if that clock was set back.
        """
        parts, rows, cells = list[tuple[SampleBlock, CellBlock]](), 0, self.cells
        for part in self._parts(cells):
            parts.append(part)
            rows += part[0].size
            if rows >= MIN_YIELDED_SAMPLES:
                yield _concatenated(parts)
                parts, rows = [], 0
        if parts:
            yield _concatenated(parts)

    def _parts(self, cells: int) -> Iterator[tuple[SampleBlock, CellBlock]]:
        """Yield the results of ``samples_with_cells`` block by block."""
        store, first_store, offset_s, last_s = 0, 0, 0.0, 0.0  # store 0: none yet
        for key in sorted(self._blocks):
            block = self._block(key)
            in_span = self._in_span(block)
            samples = block.samples[in_span]
            if not samples.size:
                continue
            first_store = first_store or block.store_created_ns
            if store not in (0, block.store_created_ns):
                offset_s = max((block.store_created_ns - first_store) * 1e-9, last_s - float(samples["time_s"][0]))
            store = block.store_created_ns
            samples["time_s"] += offset_s
            last_s = float(samples["time_s"][-1])
            has_cells = block.cells_v.shape[1] == cells
            yield samples, block.cells_v[in_span] if cells and has_cells else np.full((samples.size, cells), np.nan)

    def _in_span(self, block: Block) -> np.ndarray:
        wall_s = block.store_created_ns * 1e-9 + block.samples["time_s"]
        return (wall_s >= self.since_s) & (wall_s < self.until_s)

    def _block(self, key: tuple[int, int]) -> Block:
        return decode(self._blocks[key])


def _concatenated(parts: list[tuple[SampleBlock, CellBlock]]) -> tuple[SampleBlock, CellBlock]:
    samples, cells_v = zip(*parts, strict=True)
    return np.concatenate(samples), np.concatenate(cells_v)


def _wall_s(block: Block, sample: int) -> float:
    return block.store_created_ns * 1e-9 + float(block.samples["time_s"][sample])


async def fetch(nc: Client, pack: str, *, since_s: float = -math.inf, until_s: float = math.inf) -> BlockCapture:
    """Fetch the blocks of a pack that the stream still has.

    Args:
        nc: Connection to the tenant's NATS account.
        pack: Name of the pack.
        since_s: Beginning of the time span on the edge's clock [s since 1970].
        until_s: End of the time span [s since 1970].

    Raises:
        StreamError: The server does not respond, or has no such stream.
    """
    capture = BlockCapture(since_s, until_s)
    # without a beginning (-inf, which is no valid date) all messages are read
    first_s = None if since_s <= MAX_CLOCK_LEAD_S else since_s - MAX_CLOCK_LEAD_S
    async for batch in read_stream(nc, RAW_STREAM, f"p.*.raw.{pack}", since_s=first_s):
        for message in batch:
            capture.add(message.data)
    return capture
