"""The live view: a screen on a terminal, one line for each publication elsewhere, drawn by a thread of its own."""

import asyncio
import io
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import IO, Self, cast

from rich.console import Console
from rich.live import Live

from bms_estimator.model.estimate import Estimate, Snapshot
from bms_estimator.sinks.console_view import Scene, View, line

REDRAW_S = 0.25
"""A screen is drawn no more often than this, whatever the publish rate [s]."""
HISTORY = 256
"""Publications that the curves of voltage and current remember: the width of a very wide screen."""
WAITING_LINES = 1000
"""So many lines wait for a pipe that nobody reads; then the oldest goes. Of screens only the newest is worth waiting."""
END_LINES = 4
"""Below the view that stays there is room for what is said in the end, and for the prompt."""
CLOSE_S = 2.0
"""For so long the last view waits for a terminal that takes none [s]."""


class ConsoleSink:
    """Shows snapshots on standard output. However long that is blocked, ``publish`` returns at once.

    Args:
        log: Log lines to show below, the last ones; the screen hides what others write.
        hint: A line that stays at the foot of the screen.
        true_soc: The pack's SOC 0..1 at the last sample, where somebody knows it: a simulation does.
    """

    def __init__(
        self, *, log: Iterable[str] = (), hint: str = "", true_soc: Callable[[], float | None] | None = None
    ) -> None:
        self._console = Console(file=cast("IO[str]", _Stdout()))
        self._terminal = self._console.is_terminal
        self._log, self._hint, self._true_soc = log, hint, true_soc
        self._latest: Estimate | None = None
        self._voltage_v: deque[float] = deque(maxlen=HISTORY)
        self._current_a: deque[float] = deque(maxlen=HISTORY)
        self._waiting: deque[Scene] = deque(maxlen=1 if self._terminal else WAITING_LINES)
        self._due, self._closing = threading.Event(), threading.Event()
        self._error: OSError | None = None
        # one that is stuck in a write must not keep the process alive
        self._thread = threading.Thread(target=self._work, name="console", daemon=True)

    async def __aenter__(self) -> Self:
        """Take the screen."""
        sys.stdout.flush()
        self._thread.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Give the screen back and leave the last view on it."""
        self._closing.set()
        self._due.set()
        await asyncio.to_thread(self._thread.join, CLOSE_S)

    def publish(self, snapshot: Snapshot) -> None:
        """Show a snapshot.

        Raises:
            OSError: Standard output could not be written: nobody reads it any more, or its disk is full.
        """
        if self._error is not None:
            raise self._error
        if snapshot.estimate is not None:
            self._latest = snapshot.estimate
            self._voltage_v.append(snapshot.estimate.voltage_v)
            self._current_a.append(snapshot.estimate.current_a)
        self._waiting.append(self._scene(snapshot))
        self._due.set()

    def _scene(self, snapshot: Snapshot) -> Scene:
        return Scene(
            snapshot=snapshot,
            latest=self._latest,
            voltage_v=tuple(self._voltage_v),
            current_a=tuple(self._current_a),
            log=tuple(self._log),
            hint=self._hint,
            true_soc=self._true_soc() if self._true_soc else None,
        )

    def _work(self) -> None:
        try:
            if self._terminal:
                self._draw_screens()
            else:
                self._write_lines()
        except OSError as error:
            self._error = error

    def _draw_screens(self) -> None:
        """The newest scene, at most one each ``REDRAW_S``; the last one stays on the terminal."""
        scene: Scene | None = None
        with Live(
            console=self._console, auto_refresh=False, screen=True, redirect_stdout=False, redirect_stderr=False
        ) as live:
            for scene in self._scenes():
                live.update(View(scene), refresh=True)
                self._closing.wait(REDRAW_S)
        if scene is not None:
            self._console.print(View(scene), height=max(self._console.height - END_LINES, 1))

    def _write_lines(self) -> None:
        for scene in self._scenes():
            self._console.file.write(line(scene) + "\n")

    def _scenes(self) -> Iterable[Scene]:
        """What waits, until all is closed and nothing waits any more."""
        ended = False
        while not ended:
            self._due.wait()
            self._due.clear()
            ended = self._closing.is_set()
            while self._waiting:
                yield self._waiting.popleft()


class _Stdout(io.TextIOBase):
    """Standard output without Python's buffer: whoever is stuck in a write holds no lock that the process's end needs."""

    def write(self, text: str) -> int:
        data = text.encode(errors="replace")
        while data:
            data = data[os.write(self.fileno(), data) :]
        return len(text)

    def fileno(self) -> int:
        return sys.stdout.fileno()

    def isatty(self) -> bool:
        return sys.stdout.isatty()
