"""Interface of sources of samples: serial ports, captures, tables."""

import math
from collections.abc import AsyncIterator, Mapping
from typing import NamedTuple, Protocol, Self

from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import NO_PROBES, NO_SOC, CellBlock, ProbeBlock, SampleBlock

Chunk = tuple[float, bytes]
"""Arrival time [s since 1970] and bytes of one read."""


class SourceHealth(NamedTuple):
    """Health of a source."""

    task_idle_s: float
    """Time since its task last checked the connection or tried to open it [s]."""
    block_age_s: float
    """Time since the bytes of the latest block were read [s]."""
    queued_reads: int
    """Number of chunks that are waiting to be decoded."""


class ReadTap(Protocol):
    """Receives a copy of each chunk before it is decoded, for example to record it. It must neither block nor raise."""

    @property
    def missed_reads(self) -> int:
        """Number of chunks that the receiver could not store."""

    def write(self, arrival_s: float, data: bytes) -> None:
        """Receive one chunk."""


class ReceivedSamples(NamedTuple):
    """Block of samples, and the cell voltages and temperature probes that were measured with it."""

    samples: SampleBlock
    """Samples, shape (n,), dtype SAMPLE."""
    cells_v: CellBlock
    """Cell voltages of the samples, shape (n, m) [V]; ``NO_CELLS`` if none are measured."""
    probes: ProbeBlock = NO_PROBES
    """Temperature probes of the samples, shape (n, m); ``NO_PROBES`` without a list of them."""
    device_soc: Floats = NO_SOC
    """SOC that the device reports with each sample, 0..1, NaN without one, shape (n,); ``NO_SOC`` if it reports none."""
    device_capacity_ah: float = math.nan
    """Capacity from which the device computes its SOC [Ah]; NaN: not reported."""


class Source(Protocol):
    """Async iterator of samples, with fault counters.

    The iterator of a device never ends by itself. The iterator of a capture or a table ends with the last sample.
    """

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts since start: ``frames_received``, ``frames_lost``, ``crc_errors``, ``reconnects`` and faults by kind."""

    @property
    def silence_reason(self) -> str | None:
        """Reason why no samples arrive, as text; None while they arrive."""

    @property
    def board(self) -> Mapping[str, str]:
        """Properties from the board's hello message; empty without one."""

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock relative to the host's [1e-6]; None if unknown."""

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock; empty without one."""

    def __aiter__(self) -> AsyncIterator[ReceivedSamples]:
        """Yield blocks of samples; none of them is empty."""

    async def __aenter__(self) -> Self:
        """Open the source."""

    async def __aexit__(self, *_: object) -> None:
        """Close the source."""
