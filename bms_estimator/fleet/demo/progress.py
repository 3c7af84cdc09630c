"""Progress of the demo: a table that grows by a row every few seconds."""

import asyncio
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bms_estimator.fleet.demo.observer import Observer
from bms_estimator.fleet.demo.processes import POLL_S, Processes
from bms_estimator.fleet.heartbeat import HEARTBEAT_S

INTERVAL_S = 5.0
"""Interval between two rows [s]."""
HEADING = "    time   blocks/s      lag   SOC error   partitions"


class _RowEnd(NamedTuple):
    """Time at the end of a row, and numbers of the values received until then."""

    elapsed_s: float
    processed: int
    lags: int
    errors: int


class Progress:
    """Table of the progress.

    Args:
        observer: Received heartbeats and estimates.
        report: Receives the lines.
    """

    def __init__(self, observer: Observer, report: Callable[[str], object]) -> None:
        self._observer, self._report = observer, report
        self._begin_s = time.monotonic()
        self._last_row_end = _RowEnd(0.0, 0, 0, 0)

    @property
    def elapsed_s(self) -> float:
        """Time since the edges began to send [s]."""
        return time.monotonic() - self._begin_s

    async def show(self, until_s: float, processes: Processes) -> None:
        """Report at least one row, and further ones until a time [s since the edges began to send].

        Raises:
            UserError: A process has ended.
        """
        self._report(HEADING)
        self._last_row_end = self._row_end()
        end_s = max(until_s, self._last_row_end.elapsed_s + HEARTBEAT_S)  # each row needs a heartbeat
        while end_s - self._last_row_end.elapsed_s > HEARTBEAT_S / 2.0:
            row_s = min(self._last_row_end.elapsed_s + INTERVAL_S, end_s)
            while self.elapsed_s < row_s:
                processes.check()
                await asyncio.sleep(POLL_S)
            self._report(self._row())

    def _row_end(self) -> _RowEnd:
        observer = self._observer
        return _RowEnd(self.elapsed_s, observer.processed, len(observer.lags_s), len(observer.errors))

    def _row(self) -> str:
        """Return a row of the table for the time since the previous row."""
        observer, before, now = self._observer, self._last_row_end, self._row_end()
        self._last_row_end = now
        rate = (now.processed - before.processed) / (now.elapsed_s - before.elapsed_s)
        lag_s = max(observer.lags_s[before.lags :], default=0.0)
        errors = observer.errors[before.errors :]
        error = f"{100.0 * float(np.mean(np.abs(errors))):.1f} %" if errors else "-"
        owners = ", ".join(f"{name} {len(each.partitions)}" for name, each in sorted(observer.alive.items()))
        return f"{now.elapsed_s:6.0f} s {rate:10,.0f} {lag_s:6.1f} s {error:>11}   {owners}"
