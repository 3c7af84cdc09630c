"""The live view: a screen on a terminal, one line for each publication elsewhere."""

import time
from collections import deque
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live

from bms_estimator.model.estimate import Estimate, Snapshot
from bms_estimator.sinks.console_view import SPARK_CELLS, line, view

REDRAW_S = 0.25
"""A screen is drawn no more often than this, whatever the publish rate [s]."""


class ConsoleSink:
    """Shows snapshots.

    Args:
        console: Where; standard output when left out.
        log: Log lines to show below, the last ones; the screen hides what others write.
        hint: A line that stays at the foot of the screen.
        monotonic: Monotonic clock [s].
    """

    def __init__(
        self,
        console: Console | None = None,
        *,
        log: Iterable[str] = (),
        hint: str = "",
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console, self._log, self._hint, self._monotonic = console or Console(), log, hint, monotonic
        self._live = Live(console=self._console, auto_refresh=False, screen=True)
        self._latest: Estimate | None = None
        self._snapshot: Snapshot | None = None
        self._voltage_v: deque[float] = deque(maxlen=SPARK_CELLS)
        self._current_a: deque[float] = deque(maxlen=SPARK_CELLS)
        self._drawn_s = -REDRAW_S

    async def __aenter__(self) -> Self:
        """Take the screen."""
        if self._console.is_terminal:
            self._live.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the screen back and leave the last view on it."""
        if self._console.is_terminal:
            self._live.stop()
            if self._snapshot is not None:
                self._console.print(self._view(self._snapshot))

    def publish(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        self._snapshot = snapshot
        if snapshot.estimate is not None:
            self._latest = snapshot.estimate
            self._voltage_v.append(snapshot.estimate.voltage_v)
            self._current_a.append(snapshot.estimate.current_a)
        if not self._console.is_terminal:
            self._console.print(line(snapshot), soft_wrap=True, highlight=False, markup=False)
        elif self._monotonic() - self._drawn_s >= REDRAW_S:
            self._drawn_s = self._monotonic()
            self._live.update(self._view(snapshot), refresh=True)

    def _view(self, snapshot: Snapshot) -> RenderableType:
        return view(snapshot, self._latest, list(self._voltage_v), list(self._current_a), self._log, self._hint)
