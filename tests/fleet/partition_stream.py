"""Blocks of an edge, the stream of a partition, and an edge that resends blocks on request."""

import numpy as np

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.worker.block_result import BlockResult
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.kernels.kalman_filter.records import SCRATCH
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import PackSettings, Settings

STORE_ID_NS = 480_000 * 3600 * 10**9
"""Creation time of an edge's block store, which identifies it; it is the beginning of an hour [ns since 1970]."""
CELL = load_cell("ncr18650")
SETTINGS = Settings(pack=PackSettings(cell="ncr18650"))
SAMPLES = 20
"""Number of samples of a block."""


def table(pack: str):
    """Return settings and cell of a pack; None if the name begins with ``unknown``."""
    return None if pack.startswith("unknown") else (SETTINGS, CELL)


def one_block(samples: SampleBlock, number: int, store: int = STORE_ID_NS, oldest: int = 1) -> bytes:
    """Return the samples as one encoded block, which arrives at the time of its last sample."""
    # some tests send samples without a finite time
    arrival_s = store / 1e9 + float(np.nan_to_num(samples["time_s"][-1]))
    return encode(Block(store_created_ns=store, number=number, oldest=oldest, arrival_s=arrival_s, samples=samples))


def blocks_of(samples: SampleBlock, store: int = STORE_ID_NS, oldest: int = 1, size: int = SAMPLES) -> list[bytes]:
    """Return the samples as encoded blocks of ``size`` samples, numbered from ``oldest`` on."""
    parts = [samples[first : first + size] for first in range(0, samples.size, size)]
    return [one_block(part, number, store, oldest) for number, part in enumerate(parts, oldest)]


def estimates_of(record: np.ndarray) -> bytes:
    """Return an estimator's record, shape (1,), without scratch, and without the history, which only packs with fits record."""
    record = record.copy()
    record["filter"][SCRATCH] = 0.0
    record["history"] = np.zeros((), record.dtype["history"])
    return record.tobytes()


class Stream:
    """Partition, and the messages of its stream, whose sequence numbers begin with 1."""

    def __init__(self, partition: Partition) -> None:
        self.partition = partition
        self.messages: list[tuple[str, bytes]] = []

    def send(self, pack: str, data: bytes, *, defer: bool = False) -> BlockResult:
        """Store a block in the stream, and let the partition process or defer it."""
        self.messages.append((pack, data))
        if defer:
            return self.partition.defer(pack, len(self.messages))
        return self.partition.process(pack, data, len(self.messages))

    def process_deferred(self, max_messages: int = 10_000) -> list[BlockResult]:
        """Process deferred messages of known packs, one message of each pack in turn."""
        results: list[BlockResult] = []
        while len(results) < max_messages and (entry := self.partition.deferred.next(self.partition.in_force.is_known)):
            pack, span = entry
            messages = enumerate(self.messages, 1)
            data, sequence = next((data, n) for n, (sender, data) in messages if sender == pack and n >= span.first)
            results.append(self.partition.process_deferred(pack, data, sequence))
        return results

    def save(self, *, is_whole: bool = True) -> None:
        """Save a checkpoint, as the worker does at intervals."""
        self.partition.snapshot()
        self.partition.mark_saved(is_whole=is_whole)

    def save_twice(self) -> None:
        """Save two whole checkpoints, so that all processed blocks are safe."""
        self.save()
        self.save()

    def take_over(self) -> None:
        """Restore the partition from a snapshot, as another worker does."""
        partition = self.partition
        data = b"".join(partition.snapshot().chunks())
        self.partition = Partition.restore(partition.number, partition.in_force._table, data)


def deliver(stream: Stream, pack: str, blocks: list[bytes], first: int = 1) -> None:
    """Send blocks, numbered from ``first`` on, and resend requested ones as an edge does, until all are processed."""
    number, last = first, first + len(blocks) - 1
    while number <= last:
        reply = stream.send(pack, blocks[number - first]).reply
        number = reply.number if reply and reply.resend else number + 1
