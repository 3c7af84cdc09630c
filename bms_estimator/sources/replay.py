"""A recorded capture as a source: as fast as it goes, or paced by its time stamps."""

import asyncio
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.table import READERS, Table, table_reader

TICK_S = 0.05
"""A paced replay hands over what has become due this often [s]."""


class Decoder(Protocol):
    """What a raw capture's bytes went through."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Frames and faults by kind."""

    @property
    def board(self) -> Mapping[str, str]:
        """What the board said of itself."""


class Replay:
    """Source of the samples of a capture; ends with its last one.

    How the samples are cut into blocks never shows in the estimates.

    Args:
        capture: What is replayed.
        decoder: Who decodes it, if it is raw.
        speed: Times as fast as it was recorded; None: as fast as it goes.
        monotonic: Monotonic clock [s].
    """

    message: str | None = None
    """There is always a sample."""

    def __init__(
        self,
        capture: Table,
        *,
        decoder: Decoder | None = None,
        speed: float | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._capture, self._decoder = capture, decoder
        self._speed, self._monotonic = speed, monotonic
        self.samples = 0

    @property
    def fraction(self) -> float:
        """How much has been read, 0..1."""
        return self._capture.fraction

    @property
    def counters(self) -> Mapping[str, int]:
        """The decoder's; of a table, how many rows came."""
        return self._decoder.counters if self._decoder else {"frames_received": self.samples}

    @property
    def board(self) -> Mapping[str, str]:
        """What the board said of itself when it was recorded."""
        return self._decoder.board if self._decoder else {}

    async def __aenter__(self) -> Self:
        """Nothing to open: iterating does."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to close."""

    async def __aiter__(self) -> AsyncIterator[SampleBlock]:
        """Blocks of samples, none of them empty."""
        async for block in self._at_once() if self._speed is None else self._paced(self._speed):
            self.samples += block.size
            yield block

    async def _at_once(self) -> AsyncIterator[SampleBlock]:
        for block in self._capture:
            yield block

    async def _paced(self, speed: float) -> AsyncIterator[SampleBlock]:
        """Each sample once its time has come; the first comes at once."""
        start_s, last_s, elapsed_s = self._monotonic(), math.nan, 0.0
        for block in self._capture:
            due_s = elapsed_s + _elapsed(block["time_s"], last_s)
            first = 0
            while first < block.size:
                now_s = speed * (self._monotonic() - start_s)
                end = int(np.searchsorted(due_s, now_s, side="right"))
                if end > first:
                    yield block[first:end]
                    first = end
                else:
                    await asyncio.sleep(min((due_s[first] - now_s) / speed + TICK_S, 1.0))
            last_s, elapsed_s = float(block["time_s"][-1]), float(due_s[-1])


def _elapsed(time_s: NDArray[np.float64], last_s: float) -> NDArray[np.float64]:
    """Time since ``last_s`` [s]; steps back and stamps that are not finite take none."""
    steps = np.diff(time_s, prepend=last_s)
    return np.cumsum(np.where(np.isfinite(steps), steps, 0.0).clip(min=0.0))


def open_replay(path: Path, sensor: SensorSettings, *, speed: float | None = None) -> Replay:
    """A capture as a source, told apart by the end of its name.

    Args:
        path: The capture.
        sensor: How raw bytes are to be decoded.
        speed: Times as fast as it was recorded; None: as fast as it goes.

    Raises:
        UserError: No such file, or the name's end is unknown.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    table = table_reader(path)
    if table is None:
        raise UserError(f"{path}: what this is cannot be told: the name must end in {', '.join(READERS)}")
    return Replay(table, speed=speed)
