"""Interface of sources of samples: serial ports, captures, tables."""

from collections.abc import AsyncIterator, Mapping
from typing import NamedTuple, Protocol, Self

from bms_estimator.model.sample import CellBlock, SampleBlock

Chunk = tuple[float, bytes]
"""Arrival [s since 1970], bytes."""


class SourceHealth(NamedTuple):
    """Health of a source."""

    task_idle_s: float
    """Since its task last looked after the line, or tried to open it [s]."""
    block_age_s: float
    """Time since the bytes of the latest block were read [s]."""
    queued_reads: int
    """Chunks of the serial port that are waiting to be decoded."""


class ReadTap(Protocol):
    """Takes all that the decoder is fed, as ``Recording`` does. Does not wait, and raises nothing."""

    @property
    def missed_reads(self) -> int:
        """Reads of the line that it could not take."""

    def write(self, arrival_s: float, data: bytes) -> None:
        """Take one read of the line."""


class Source(Protocol):
    """An async iterator of SAMPLE blocks with fault counters.

    A serial board never ends by itself; a capture or a table ends with its last row.
    """

    @property
    def counters(self) -> Mapping[str, int]:
        """Since start: ``frames_received``, ``frames_lost``, ``crc_errors``, ``reconnects`` and faults by kind."""

    @property
    def message(self) -> str | None:
        """Reason why no samples arrive, for people; None when they do."""

    @property
    def board(self) -> Mapping[str, str]:
        """Hello of the board; empty without one."""

    @property
    def clock_ppm(self) -> float | None:
        """Rate of the board's clock over the host's [1e-6]; None if unknown."""

    @property
    def cells(self) -> CellBlock:
        """Cell voltages of the latest block; ``NO_CELLS`` where no cells are measured."""

    def __aiter__(self) -> AsyncIterator[SampleBlock]:
        """Blocks of samples, none of them empty."""

    async def __aenter__(self) -> Self:
        """Open."""

    async def __aexit__(self, *_: object) -> None:
        """Close."""
