"""Live view of the pack that this process serves, without a broker.

A thread draws it on standard output: a screen on a terminal, otherwise one line of text for each message.
"""

import asyncio
import io
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import IO, Self, TypeVar, cast

from rich import box
from rich.console import Console, Group, RenderableType
from rich.screen import Screen
from rich.table import Table
from rich.text import Text

from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import Message
from bms_estimator.mqtt.topic_cache import DeviceMessage, TopicCache
from bms_estimator.sinks.mqtt.messages import MessageBuilder, PublishedState
from bms_estimator.sinks.terminal.view_state import (
    ALARM_PREFIX,
    NOT_KNOWN,
    JsonFields,
    PackView,
    ViewState,
    clock_text,
    cutoff_band_text,
    soc_text,
)
from bms_estimator.telemetry.state import CUTOFF_FIELDS, cutoff_text

MIN_TABLE_CELLS = 80
"""Minimum width of the table [cells]. A narrower terminal crops the right columns."""
MIN_WIDE_TABLE_CELLS = 96
"""Minimum width of the table with the remaining charge [cells]."""
LOG_LINES = 2
"""Number of log lines on the screen."""
MAX_MESSAGES = 5
"""Maximum number of alarms and faults that are listed."""
URGENT_STYLE = "bold red"
"""Style of critical alarms and of faults, which are listed first."""


def build_screen(view: ViewState, width: int) -> RenderableType:
    """Return the screen for a terminal of ``width`` cells."""
    messages = [] if view.pack is None else _messages(view.pack)
    messages.sort(key=lambda message: message.style != URGENT_STYLE)
    table = "nothing has been published yet" if view.pack is None else _pack_table(view, view.pack, width)
    lines: list[RenderableType] = [table, *messages[:MAX_MESSAGES]]
    if len(messages) > MAX_MESSAGES:
        lines.append(Text(f"alarms and faults not shown: {len(messages) - MAX_MESSAGES}", style=URGENT_STYLE))
    return Group(*lines, *map(Text.from_ansi, view.log[-LOG_LINES:]), Text(view.hint, style="cyan"))


def _pack_table(view: ViewState, pack: PackView, width: int) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    table.width = MIN_TABLE_CELLS if width < MIN_TABLE_CELLS else None
    table.add_column("Pack", overflow="fold")
    table.add_column("SOC %\n± 2 std", no_wrap=True, style="bold")
    if view.true_soc is not None:
        table.add_column("True\nSOC %", no_wrap=True, style="magenta")
    table.add_column(f"State at\n{clock_text(view.now_s)}", no_wrap=True)
    is_wide = width >= MIN_WIDE_TABLE_CELLS
    remaining = ("To 0 %\nAh",) if is_wide else ()
    for heading in ("Voltage\nV", "Current\nA", "Power\nW", *remaining, "To cut-off\nh, 90 %", "Innovation\nmV"):
        table.add_column(heading, justify="right", no_wrap=True)
    state, is_stale = pack.fields("state"), pack.stale_since() is not None
    table.add_row(
        Text(pack.device),
        soc_text(state),
        *([] if view.true_soc is None else [f"{100.0 * view.true_soc:.2f}"]),
        Text("stale" if is_stale else "live", style=URGENT_STYLE if is_stale else "bold green"),
        state.number_text("voltage_v", ".3f"),
        state.number_text("current_a", "+.3f"),
        state.number_text("power_w", "+.2f"),
        *([state.number_text("remaining_capacity_ah", ".3f")] if is_wide else []),
        cutoff_band_text(state),
        state.number_text("innovation_v", "+.1f", 1e3),
        style="dim" if is_stale else "",
    )
    return table


def _messages(pack: PackView) -> list[Text]:
    """Return a line for each alarm, the reason why the values are stale, and each input diagnostic."""
    health, since = pack.fields("health"), pack.stale_since()
    messages = [
        Text(_alarm_text(alarm), style=URGENT_STYLE if alarm.text("severity") == "critical" else "yellow")
        for alarm in pack.alarms()
    ]
    reason = health.text("sensor_message")
    if reason or since is not None:
        status = "live" if since is None else f"stale since {since}" if since else "stale"
        messages.append(Text(f"{status}{reason and ': '}{reason}", style=URGENT_STYLE))
    return messages + [Text(f"suspected: {each}", style="yellow") for each in health.texts("suspects")]


def _alarm_text(alarm: JsonFields) -> str:
    if not alarm.flag("active"):
        return f"{alarm.text('name')} cannot be raised: {alarm.text('unwatched_reason')}"
    return f"{alarm.text('severity')} since {alarm.text('since')}: {alarm.text('text')}"


def text_line(message: DeviceMessage, true_soc: float | None = None) -> str | None:
    """Return one line; None for a message that is not printed.

    Args:
        message: A message of a pack.
        true_soc: SOC 0..1 of a simulated pack.
    """
    fields = JsonFields(message.payload)
    if message.topic == "state" and fields:
        return _state_line(message.device, fields, true_soc)
    if message.topic == "health" and fields and not fields.flag("sensor_online"):
        return f"{fields.text('publish_time')} {message.device}: {fields.text('sensor_message') or 'no sample'}"
    if message.topic.startswith(ALARM_PREFIX) and fields.flag("active"):
        return f"{fields.text('since')} {message.device}: alarm, {fields.text('severity')}: {fields.text('text')}"
    return None


def _state_line(device: str, state: JsonFields, true_soc: float | None) -> str:
    number = state.number_text
    gain = f"N {number('nussbaum_gain', '.4f')}"
    if state.number("adaptation_gain_hz") is not None:
        gain = f"gamma k {number('adaptation_gain_hz', '.4f')}/s"
    cutoff = cutoff_text(*(state.number(name) for name in CUTOFF_FIELDS)) or "-"
    soc = soc_text(state)
    truth = "" if true_soc is None else f"  true {100.0 * true_soc:.2f} %"
    return (
        f"{state.text('time')} {device}: soc {soc}{'' if soc == NOT_KNOWN else ' %'}{truth}  "
        f"{number('voltage_v', '.3f')} V  {number('current_a', '+.3f')} A  {number('power_w', '+.2f')} W  "
        f"to cut-off {cutoff}  margin {number('stability_margin', '.4f')}  "
        f"delta1 {number('delta_1', '.4f')}  delta2 {number('delta_2', '.4f')}  "
        f"innovation {number('innovation_v', '+.2f', 1e3)} mV  observer {'in' if state.flag('lock') else 'OUT OF'} lock, "
        f"{'converged' if state.flag('converged') else 'converging'}, e {number('tracking_error_v', '+.2f', 1e3)} mV  "
        f"{gain}  k {number('adaptive_gain_k', '.3g')}  "
        f"frames {state.count('frames_received')}  lost {state.count('frames_lost')}"
    )


REDRAW_S = 0.25
"""Minimum interval between two screens, at any publish rate [s]."""
REPAINT_S = 30.0
"""Interval after which unchanged lines are drawn too, because another program may have written over them [s]."""
MAX_WAITING_LINES = 1000
"""Maximum number of lines that wait for a blocked pipe. Beyond it, the oldest line is dropped."""
SHUTDOWN_TIMEOUT_S = 2.0
"""Timeout of the last write to a blocked terminal [s]."""


BASE_TOPIC = "bms"
"""Base topic of the messages, which are not sent."""
T = TypeVar("T")


class TerminalSink:
    """Sink that shows snapshots as a subscriber would see them. No method waits for a blocked standard output.

    Args:
        log: Log lines. The last of them are shown, because the screen hides log output.
        hint: Last line of the screen.
        true_soc: Returns the pack's true SOC 0..1 at the last sample, in a simulation.
        clock: Wall clock and monotonic clock.
    """

    def __init__(
        self,
        *,
        log: Iterable[str] = (),
        hint: str = "",
        true_soc: Callable[[], float | None] = lambda: None,
        clock: Clock | None = None,
    ) -> None:
        self._clock, self._cache, self._sent = clock or Clock(), TopicCache(BASE_TOPIC), PublishedState()
        self._builder: MessageBuilder | None = None
        self._previous: Snapshot | None = None
        self._console = Console(file=cast("IO[str]", _UnbufferedStdout()))
        self._terminal = self._console.is_terminal
        self._log, self._hint, self._true_soc = log, hint, true_soc
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
        await asyncio.to_thread(self._thread.join, SHUTDOWN_TIMEOUT_S)

    def publish(self, snapshot: Snapshot) -> None:
        """Let the thread draw a snapshot, or write a line for each of its messages if standard output is no terminal.

        Raises:
            OSError: Standard output could not be written: its reader has gone, or its disk is full.
        """
        for message in self._messages(snapshot):
            received = self._cache.add_message(message.topic, message.payload, self._clock.wall())
            if received and not self._terminal and (line := text_line(received, self._true_soc())) is not None:
                self._lines.append(line)
        if self._error is not None:
            raise self._error
        if self._terminal:
            self._states.append(self._present_state())
        self._draw_event.set()

    def _messages(self, snapshot: Snapshot) -> list[Message]:
        """Return the messages that a broker would receive."""
        birth: list[Message] = []
        if self._builder is None:
            self._builder = MessageBuilder(BASE_TOPIC, snapshot.info.device)
            birth = self._builder.birth_messages()
        guaranteed_messages = self._builder.guaranteed_messages(self._previous, snapshot)
        live, self._sent = self._builder.live_messages(self._sent, snapshot, self._clock.monotonic())
        self._previous = snapshot
        return [*birth, *guaranteed_messages, *live]

    def _present_state(self) -> ViewState:
        """Return a copy, because the drawing thread must not see changes."""
        packs = (PackView(name, dict(device.topics)) for name, device in self._cache.devices.items())
        return ViewState(self._clock.wall(), next(packs, None), tuple(self._log), self._hint, self._true_soc())

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
        """Draw the newest state at most once each ``REDRAW_S``, only its changed lines. The last screen stays on the terminal."""
        screen = None
        drawn = set[tuple[object, int, str]]()
        with self._console.screen():
            for state in self._until_closed(self._states):
                screen = build_screen(state, self._console.width)
                with self._console.capture() as capture:
                    self._console.print(Screen(screen), end="")
                # a new value of ``frame`` makes all lines differ from the drawn ones, so that all are drawn
                frame = self._console.size, state.now_s // REPAINT_S
                lines: set[tuple[object, int, str]] = {
                    (frame, row, line) for row, line in enumerate(capture.get().split("\n"), 1)
                }
                self._console.file.write("".join(f"\x1b[{row};1H{line}" for _, row, line in sorted(lines - drawn)))
                drawn = lines
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
