"""Live view on standard output, drawn by a separate thread: a screen on a terminal, otherwise one line per message."""

import asyncio
import io
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import IO, Self, TypeVar, cast

from rich.console import Console
from rich.live import Live

from bms_estimator.mqtt.topic_cache import DeviceMessage, DeviceTopics
from bms_estimator.sinks.terminal.screen import build_screen
from bms_estimator.sinks.terminal.text_line import text_line
from bms_estimator.sinks.terminal.view_state import PackView, ViewState

REDRAW_S = 0.25
"""Minimum interval between two screens, at any publish rate [s]."""
MAX_WAITING_LINES = 1000
"""Maximum number of lines that wait for a blocked pipe. Beyond it, the oldest line is dropped."""
CLOSE_S = 2.0
"""Timeout of the last write to a blocked terminal [s]."""


T = TypeVar("T")


class LiveView:
    """View of the pack's publications on standard output. No method waits for a blocked standard output.

    Args:
        devices: Last publications of the pack, by its name.
        log: Log lines. The last of them are shown, because the screen hides log output.
        hint: Last line of the screen.
        true_soc: Returns the pack's true SOC 0..1 at the last sample, in a simulation.
        wall: Wall clock, seconds since 1970.
    """

    def __init__(
        self,
        devices: Mapping[str, DeviceTopics],
        *,
        log: Iterable[str] = (),
        hint: str = "",
        true_soc: Callable[[], float | None] = lambda: None,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._console = Console(file=cast("IO[str]", _UnbufferedStdout()))
        self._terminal = self._console.is_terminal
        self._devices, self._log, self._hint, self._wall = devices, log, hint, wall
        self._true_soc = true_soc
        self._states: deque[ViewState] = deque(maxlen=1)  # a newer state replaces one that was not drawn
        self._lines: deque[str] = deque(maxlen=MAX_WAITING_LINES)
        self._draw_event, self._closing = threading.Event(), threading.Event()
        self._error: OSError | None = None
        # a daemon: a thread that is blocked in a write must not keep the process alive
        self._thread = threading.Thread(target=self._run_thread, name="console", daemon=True)

    async def __aenter__(self) -> Self:
        """Start the drawing thread."""
        sys.stdout.flush()
        self._thread.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Restore the terminal and print the last screen once more."""
        self._closing.set()
        self._draw_event.set()
        await asyncio.to_thread(self._thread.join, CLOSE_S)

    def on_message(self, message: DeviceMessage) -> None:
        """Queue the line of a message, if standard output is no terminal."""
        if not self._terminal and (line := text_line(message, self._true_soc())) is not None:
            self._lines.append(line)

    def show(self) -> None:
        """Let the thread draw the present state, or write the queued lines.

        Raises:
            OSError: Standard output could not be written: its reader has gone, or its disk is full.
        """
        if self._error is not None:
            raise self._error
        if self._terminal:
            self._states.append(self._present_state())
        self._draw_event.set()

    def _present_state(self) -> ViewState:
        """Return a copy, because the drawing thread must not see changes."""
        packs = (PackView(name, dict(device.topics)) for name, device in self._devices.items())
        return ViewState(self._wall(), next(packs, None), tuple(self._log), self._hint, self._true_soc())

    def _run_thread(self) -> None:
        try:
            if self._terminal:
                self._draw_screens()
            else:
                for line in self._until_closed(self._lines):
                    self._console.file.write(line + "\n")
        except OSError as error:
            self._error = error

    def _draw_screens(self) -> None:
        """Draw the newest state at most once each ``REDRAW_S``. The last screen stays on the terminal."""
        screen = None
        with Live(
            console=self._console, auto_refresh=False, screen=True, redirect_stdout=False, redirect_stderr=False
        ) as live:
            for state in self._until_closed(self._states):
                screen = build_screen(state, self._console.width)
                live.update(screen, refresh=True)
                self._closing.wait(REDRAW_S)
        if screen is not None:
            self._console.print(screen)

    def _until_closed(self, waiting: deque[T]) -> Iterable[T]:
        """Yield the waiting items until the view is closed and no item waits."""
        closed = False
        while not closed:
            self._draw_event.wait()
            self._draw_event.clear()
            closed = self._closing.is_set()
            while waiting:
                yield waiting.popleft()


class _UnbufferedStdout(io.TextIOBase):
    """Standard output without Python's buffer: a blocked write holds no lock that the process needs to end."""

    def write(self, text: str) -> int:
        data = text.encode(errors="replace")
        while data:
            data = data[os.write(self.fileno(), data) :]
        return len(text)

    def fileno(self) -> int:
        return sys.stdout.fileno()

    def isatty(self) -> bool:
        return sys.stdout.isatty()
