"""Progress of the demo: a table that grows by a row every few seconds."""

import asyncio
import time
from collections.abc import Callable

from bms_estimator.fleet.demo.observer import Observer
from bms_estimator.fleet.demo.processes import POLL_S, Processes
from bms_estimator.fleet.heartbeat import HEARTBEAT_S

INTERVAL_S = 5.0
"""Interval between two rows [s]."""
HEADING = "    time   blocks/s      lag   partitions"


class Progress:
    """Table of the progress.

    Args:
        observer: Received heartbeats and estimates.
        report: Receives the lines.
    """

    def __init__(self, observer: Observer, report: Callable[[str], object]) -> None:
        self._observer, self._report = observer, report
        self._begin_s = time.monotonic()

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
        end_s = -1.0
        while end_s < until_s:
            begin_s, processed, lags = self.elapsed_s, self._observer.processed, len(self._observer.lags_s)
            end_s = min(begin_s + INTERVAL_S, max(until_s, begin_s + HEARTBEAT_S))  # each row needs a heartbeat
            while self.elapsed_s < end_s:
                processes.check()
                await asyncio.sleep(POLL_S)
            rate = (self._observer.processed - processed) / (self.elapsed_s - begin_s)
            lag_s = max(self._observer.lags_s[lags:], default=0.0)
            owners = ", ".join(f"{name} {len(each.partitions)}" for name, each in sorted(self._observer.alive.items()))
            self._report(f"{self.elapsed_s:6.0f} s {rate:10,.0f} {lag_s:6.1f} s   {owners}")
