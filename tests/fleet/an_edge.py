"""An edge's blocks, and an edge as its store and the worker's answers make it: it sends again from where it is asked."""

import numpy as np

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.worker.partition import BlockResult, Partition
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.pack import PackSettings, Settings

STORE = 480_000 * 3600 * 10**9
"""When a store was made: the begin of an hour [ns since 1970]."""
CELL = load_cell("ncr18650")
SETTINGS = Settings(pack=PackSettings(cell="ncr18650"))
SAMPLES = 20
"""Of a block."""


def table(pack: str):
    return None if pack.startswith("unknown") else (SETTINGS, CELL)


def one_block(samples: SampleBlock, number: int, store: int = STORE, oldest: int = 1) -> bytes:
    arrival_s = store / 1e9 + float(np.nan_to_num(samples["time_s"][-1]))
    return encode(Block(store, number, oldest, arrival_s, samples))


def blocks_of(samples: SampleBlock, store: int = STORE, oldest: int = 1, size: int = SAMPLES) -> list[bytes]:
    """By their numbers, from ``oldest`` on."""
    parts = [samples[first : first + size] for first in range(0, samples.size, size)]
    return [one_block(part, number, store, oldest) for number, part in enumerate(parts, oldest)]


class Stream:
    """What a partition takes, with the sequence of the stream."""

    def __init__(self, partition: Partition) -> None:
        self.partition = partition
        self.messages: list[tuple[str, bytes]] = []

    def send(self, pack: str, data: bytes, *, waits: bool = False) -> BlockResult:
        self.messages.append((pack, data))
        if waits:
            return self.partition.defer(pack, len(self.messages))
        return self.partition.take(pack, data, len(self.messages))

    def take_deferred(self, most: int = 10_000) -> list[BlockResult]:
        """Take what waits of known packs, one message of each at a time."""
        made: list[BlockResult] = []
        while len(made) < most and (found := self.partition.deferred.next(self.partition.is_known)):
            pack, span = found
            messages = enumerate(self.messages, 1)
            data, sequence = next((data, n) for n, (of, data) in messages if of == pack and n >= span.first)
            made.append(self.partition.take_deferred(pack, data, sequence))
        return made

    def take_over(self) -> None:
        """Another worker goes on from a snapshot."""
        partition = self.partition
        data = b"".join(partition.snapshot().chunks())
        self.partition = Partition.restore(partition.number, partition._table, data)


def deliver(stream: Stream, pack: str, blocks: list[bytes], first: int = 1) -> None:
    """Send all, again from where the worker asks, until the last is taken."""
    number, last = first, first + len(blocks) - 1
    while number <= last:
        awaits = stream.send(pack, blocks[number - first]).awaits
        number = awaits.number if awaits and awaits.resend else number + 1
