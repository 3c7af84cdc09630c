"""The live view: a screen on a terminal, a line for each state elsewhere, drawn by a thread of its own."""

import asyncio
import io
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import IO, Self, TypeVar, cast

from rich.console import Console
from rich.live import Live

from bms_estimator.mqtt.topic_cache import DeviceMessage, DeviceTopics
from bms_estimator.sinks.terminal.json_fields import JsonFields
from bms_estimator.sinks.terminal.panels import Screen
from bms_estimator.sinks.terminal.scene import BrokerOutage, PackView, ScreenState
from bms_estimator.sinks.terminal.text_line import line

REDRAW_S = 0.25
"""Minimum interval of drawing a screen, at any publish rate [s]."""
HISTORY = 256
"""Publications that the curves of voltage and current remember: the width of a very wide screen."""
WAITING_LINES = 1000
"""Maximum number of lines waiting for a pipe that is not read; then the oldest is dropped."""
END_LINES = 4
"""Lines left free below the last view for final messages and the prompt."""
CLOSE_S = 2.0
"""Time that the last view waits for a terminal that does not read [s]."""


T = TypeVar("T")


@dataclass
class Curves:
    """Curves of one pack."""

    voltage_v: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))
    current_a: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))


class LiveView:
    """Shows what packs publish on standard output. However long that is blocked, no call here waits for it.

    Args:
        devices: What each pack published last.
        log: Log lines to show below, the last ones; the screen hides what others write.
        hint: A line that stays at the foot of the screen.
        true_soc: Returns the pack's true SOC 0..1 at the last sample, in a simulation.
        lost: Time since which there is no broker, if one is needed.
        first: The pack that is shown first, where it is there.
        wall: Wall clock, seconds since 1970.
    """

    def __init__(
        self,
        devices: Mapping[str, DeviceTopics],
        *,
        log: Iterable[str] = (),
        hint: str = "",
        true_soc: Callable[[], float | None] = lambda: None,
        lost: Callable[[], BrokerOutage | None] = lambda: None,
        first: str = "",
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._console = Console(file=cast("IO[str]", _Stdout()))
        self._terminal = self._console.is_terminal
        self._devices, self._log, self._hint, self._wall = devices, log, hint, wall
        self._true_soc, self._lost, self._selected = true_soc, lost, first
        self._curves: dict[str, Curves] = {}
        self._scene: deque[ScreenState] = deque(maxlen=1)  # only the newest is worth waiting
        self._lines: deque[str] = deque(maxlen=WAITING_LINES)
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

    def on_message(self, heard: DeviceMessage) -> None:
        """Take a message of a pack, which ``devices`` holds already; without a screen it may be a line."""
        if heard.device not in self._devices:
            self._curves.pop(heard.device, None)
        elif heard.topic == "state":
            self._remember(heard)
        if not self._terminal and (text := line(heard, self._true_soc())) is not None:
            self._lines.append(text)

    def show(self) -> None:
        """Have drawn what there is now.

        Raises:
            OSError: Standard output could not be written: its reader has gone, or its disk is full.
        """
        if self._error is not None:
            raise self._error
        if self._terminal:
            self._scene.append(self._scene_now())
        self._due.set()

    def select(self, step: int) -> None:
        """Show another pack: the next (1), the one before (-1)."""
        names = list(self._devices)
        if names:
            at = names.index(self._selected) if self._selected in names else 0
            self._selected = names[(at + step) % len(names)]
        self.show()

    def _remember(self, heard: DeviceMessage) -> None:
        if len(self._curves) > len(self._devices):  # some devices were replaced
            self._curves = {name: curves for name, curves in self._curves.items() if name in self._devices}
        curves = self._curves.setdefault(heard.device, Curves())
        state = JsonFields(heard.payload)
        voltage_v, current_a = state.number("voltage_v"), state.number("current_a")
        if voltage_v is not None and current_a is not None:
            curves.voltage_v.append(voltage_v)
            curves.current_a.append(current_a)

    def _scene_now(self) -> ScreenState:
        """Return a copy, because the drawing thread must not see changes."""
        now_s, lost = self._wall(), self._lost()
        packs = [
            PackView(name, dict(device.topics), max(device.heard_s.values()), now_s, lost)
            for name, device in self._devices.items()
        ]
        shown = next((pack for pack in packs if pack.device == self._selected), None)
        shown = shown or (packs[0] if packs else PackView(now_s=now_s, lost=lost))
        curves = self._curves.get(shown.device, Curves())
        return ScreenState(
            shown.device,
            shown.topics,
            shown.heard_s,
            now_s,
            lost,
            packs=packs,
            voltage_v=tuple(curves.voltage_v),
            current_a=tuple(curves.current_a),
            log=tuple(self._log),
            hint=self._hint,
            true_soc=self._true_soc(),
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
        """Draw the newest scene at most once each ``REDRAW_S``; the last one stays on the terminal."""
        scene: ScreenState | None = None
        with Live(
            console=self._console, auto_refresh=False, screen=True, redirect_stdout=False, redirect_stderr=False
        ) as live:
            for scene in self._taken(self._scene):
                live.update(Screen(scene), refresh=True)
                self._closing.wait(REDRAW_S)
        if scene is not None:
            self._console.print(Screen(scene), height=max(self._console.height - END_LINES, 1))

    def _write_lines(self) -> None:
        for text in self._taken(self._lines):
            self._console.file.write(text + "\n")

    def _taken(self, waiting: deque[T]) -> Iterable[T]:
        """Yield the waiting items until the queue is closed and empty."""
        ended = False
        while not ended:
            self._due.wait()
            self._due.clear()
            ended = self._closing.is_set()
            while waiting:
                yield waiting.popleft()


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
