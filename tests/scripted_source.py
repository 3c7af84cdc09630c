"""Source that yields the blocks of a test, and sink that stores the snapshots."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Self

import numpy as np

from bms_estimator.model.arrays import NO_CELLS, SAMPLE, CellBlock, SampleBlock
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.sinks.sink import Sink
from bms_estimator.sources.source import ReceivedSamples
from tests.patience import LONG_S


class ScriptedSource:
    """Source that yields blocks from a queue until ``finish``."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = {"frames_received": 0, "frames_lost": 0, "crc_errors": 0, "reconnects": 0}
        self.silence_reason: str | None = None
        self.board: dict[str, str] = {}
        self.clock_ppm: float | None = None
        self.clock_fault = self.conflict = ""
        self._queue: asyncio.Queue[ReceivedSamples | None] = asyncio.Queue()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        while (received := await self._queue.get()) is not None:
            self.counters["frames_received"] += received.samples.size
            yield received

    def give(self, *rows: tuple[float, float, float] | tuple[float, float, float, float, int]) -> None:
        """Add a block with rows of (time_s, current_a, voltage_v[, temperature_c, status])."""
        padded = [row if len(row) == 5 else (*row, np.nan, 0) for row in rows]
        self.give_block(np.array([(*row[:4], row[3], row[3], row[4]) for row in padded], dtype=SAMPLE))

    def give_block(self, samples: SampleBlock, cells_v: CellBlock = NO_CELLS, capacity_ah: float = np.nan) -> None:
        """Add a block of samples with their cell voltages, and the capacity that the device reports."""
        self._queue.put_nowait(ReceivedSamples(samples, cells_v, device_capacity_ah=capacity_ah))

    def finish(self) -> None:
        self._queue.put_nowait(None)


class Collector(Sink):
    """Sink that stores its snapshots."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self._received = asyncio.Event()

    def publish(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)
        self._received.set()

    async def until(self, accepts: Callable[[Snapshot], bool], skip: int = 0) -> Snapshot:
        """Wait for a snapshot that ``accepts`` accepts, and return it. The first ``skip`` snapshots are ignored."""
        checked = skip
        async with asyncio.timeout(LONG_S):
            while True:
                self._received.clear()
                for snapshot in self.snapshots[checked:]:
                    if accepts(snapshot):
                        return snapshot
                checked = max(checked, len(self.snapshots))
                await self._received.wait()
