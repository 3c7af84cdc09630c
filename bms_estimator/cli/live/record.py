"""``bms-estimator record``: capture of a board's raw bytes with their arrival times."""

import asyncio
import time
from collections import deque
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from bms_estimator.cli.options.pack_options import PortOverride, decimal, load_pack, whole, with_sensor
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import configure_logs, flush_logs, stop_on_signal, until_first_ends
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.factory import open_device
from bms_estimator.sources.source import Source

REDRAW_S = 0.25
"""Interval between two updates of the progress line [s]."""
RATE_INTERVAL_S = 1.0
"""Minimum time over which the displayed frame rate is averaged [s]."""


def record(
    out: Annotated[Path, typer.Argument(help="file to create", show_default=False)],
    pack: Annotated[
        Path | None,
        typer.Option(
            help="settings file of the pack, pack.toml, whose section \\[sensor] or \\[source] describes the device",
            show_default=False,
        ),
    ] = None,
    port: PortOverride = None,
    baud: Annotated[
        int | None, typer.Option(parser=whole(1200), help="baud rate that replaces sensor.baud of the settings")
    ] = None,
    rate_hz: Annotated[
        int | None,
        typer.Option(
            parser=whole(1, 1000), help="sample rate [Hz] that replaces sensor.sample_rate_hz of the settings"
        ),
    ] = None,
    text: Annotated[bool, typer.Option("--text", help="the board sends text lines, not binary frames")] = False,
    seconds: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0),
            help="duration in seconds, counted from the first received bytes; default: until Ctrl-C",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Record the raw bytes of a sensor board or another device with their arrival times, until Ctrl-C.

    Bytes are written as they arrive, so that the file is readable even if the command is killed.
    Without --pack and --port, the command records the only connected board.
    """
    settings = load_pack(pack)[0] if pack else Settings()
    protocol = "text" if text else None
    settings = with_sensor(settings, port=port, baud=baud, sample_rate_hz=rate_hz, protocol=protocol)
    with flush_logs(), CaptureRecorder(out, make_header(settings.sensor, settings.source)) as recording:
        progress = asyncio.run(_record(settings, recording, seconds))
    if recording.fault:
        raise UserError(f"recording ended: {recording.fault}")
    typer.echo(progress.summary(), err=True)


async def _record(settings: Settings, recording: CaptureRecorder, seconds: float | None) -> "Progress":
    """Record a source until a signal, the end of the duration, or a disk error."""
    stop = stop_on_signal()
    console, log = Console(stderr=True), deque[str]()
    configure_logs(log if console.is_terminal else None)
    async with open_device(settings, tap=recording) as source:
        progress = Progress(source, recording)
        await until_first_ends(
            stop.wait(),
            recording.wait_for_end(),
            _read_all(source),
            _wait_for_duration(recording, seconds),
            _show_progress(console, progress, log),
        )
    return progress


async def _read_all(source: Source) -> None:
    """Read the source until it ends; its tap, the recorder, receives a copy of all bytes."""
    async for _ in source:
        pass


async def _wait_for_duration(recording: CaptureRecorder, seconds: float | None) -> None:
    """Wait until ``seconds`` after the first bytes; forever if None."""
    while seconds is None or not recording.bytes:  # noqa: ASYNC110 - the recorder has no event for its first bytes
        await asyncio.sleep(REDRAW_S)
    await asyncio.sleep(seconds)


async def _show_progress(console: Console, progress: "Progress", log: deque[str]) -> None:
    """Show a progress line on a terminal, with the log's lines above it."""
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while True:
            while log:
                console.print(Text.from_ansi(log.popleft()))
            if console.is_terminal:
                live.update(progress.line(), refresh=True)
            await asyncio.sleep(REDRAW_S)


class Progress:
    """Progress of a recording."""

    def __init__(self, source: Source, recording: CaptureRecorder) -> None:
        self._source, self._recording = source, recording
        self._started_s = time.monotonic()
        self._rate_since_s, self._frames_before = self._started_s, 0
        self._rate_hz = 0.0

    def line(self) -> Text:
        """Return the progress as one line."""
        message = f"  {self._source.silence_reason}" if self._source.silence_reason else ""
        now_s, frames = time.monotonic(), self._source.counters["frames_received"]
        if now_s - self._rate_since_s >= RATE_INTERVAL_S:
            self._rate_hz = (frames - self._frames_before) / (now_s - self._rate_since_s)
            self._rate_since_s, self._frames_before = now_s, frames
        return Text(f"{self.summary()}, {self._rate_hz:.0f} Hz{message}", no_wrap=True, overflow="ellipsis")

    def summary(self) -> str:
        """Return a summary of the whole recording."""
        counters = self._source.counters
        other_faults = sum(
            counters.get(name, 0) for name in ("cobs_errors", "length_errors", "version_errors", "text_errors")
        )
        return (
            f"{time.monotonic() - self._started_s:.1f} s, {self._recording.bytes:,} bytes, "
            f"{counters['frames_received']:,} frames, {counters.get('frames_lost', 0):,} lost, "
            f"{counters.get('crc_errors', 0):,} CRC errors, {other_faults:,} other faults"
        )
