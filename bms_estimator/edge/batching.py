"""Division of samples into blocks. No I/O."""

from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import NO_CELLS, CellBlock, SampleBlock

MAX_SAMPLES = 7_000
"""Maximum number of samples in a block. A block of this many incompressible samples stays below
``fleet.nats.streams.MAX_BLOCK_BYTES``."""


class ReadyBlock(NamedTuple):
    """Samples of a completed block, with the arrival time of the last one."""

    arrival_s: float
    """Wall clock [s since 1970]."""
    samples: SampleBlock
    cells_v: CellBlock = NO_CELLS
    """Cell voltages of the samples, shape (n, m) [V]; empty if there are none."""


class Batcher:
    """Divider of samples into blocks of equal duration.

    Args:
        block_s: Minimum time from the first sample of a block to that of the next one [s].
        max_samples: Maximum number of samples in a block.
    """

    def __init__(self, block_s: float, max_samples: int = MAX_SAMPLES) -> None:
        self._block_s, self._max_samples = block_s, max_samples
        self._parts: list[SampleBlock] = []
        # cell voltages of the same samples; the number of cells may differ between parts
        self._cell_parts: list[CellBlock] = []
        self._count, self._arrival_s = 0, 0.0  # samples in the open block, and arrival of the last one
        self._end_s = 0.0  # sample time at which the open block ends

    def __len__(self) -> int:
        """Return the number of samples in the open block."""
        return self._count

    def add(self, samples: SampleBlock, arrival_s: float, cells_v: CellBlock = NO_CELLS) -> list[ReadyBlock]:
        """Add samples in order of their times, with their cell voltages, if any. Return the blocks that they complete."""
        completed = []
        cells_v = cells_v if cells_v.size else np.empty((samples.size, 0))
        while samples.size:
            if not self._count:
                self._end_s = float(samples["time_s"][0]) + self._block_s
            before_end = int(np.searchsorted(samples["time_s"], self._end_s))
            end = min(before_end, self._max_samples - self._count)
            part, samples = samples[:end], samples[end:]
            self._parts.append(part)
            self._cell_parts.append(cells_v[:end])
            cells_v = cells_v[end:]
            self._count += part.size
            self._arrival_s = arrival_s if part.size else self._arrival_s
            if samples.size or self._count == self._max_samples:
                completed += self.cut()
        return completed

    def cut(self) -> list[ReadyBlock]:
        """Complete the open block. Return an empty list if it has no samples."""
        if not self._count:
            return []
        block = ReadyBlock(self._arrival_s, np.concatenate(self._parts), _concatenate_cells(self._cell_parts))
        self._parts, self._cell_parts, self._count = [], [], 0
        return [block]


def _concatenate_cells(parts: list[CellBlock]) -> CellBlock:
    """Concatenate the cell voltages of successive samples. A part with fewer cells than the others is filled with NaN."""
    cells = max(part.shape[1] for part in parts)
    if not cells:
        return NO_CELLS
    return np.concatenate(
        [np.pad(part, ((0, 0), (0, cells - part.shape[1])), constant_values=np.nan) for part in parts]
    )
