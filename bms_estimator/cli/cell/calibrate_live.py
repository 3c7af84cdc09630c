"""Guided test of a connected pack: reads samples, shows the screen, and switches the load within the pack's limits."""

import asyncio
import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from bms_estimator.calibration.guided_test.averages import means_of_windows
from bms_estimator.calibration.guided_test.guided_test import GuidedTest, OcvPoint, Phase
from bms_estimator.calibration.guided_test.plan import PLANS, Limits
from bms_estimator.cli.cell.calibration_session import Session, join_recordings, start_time
from bms_estimator.cli.cell.load_switch import LoadSwitch, SetLoad, board_relay
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.available_power import power_limits
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import configure_logs, end_tasks, stop_on_signal, until_first_ends
from bms_estimator.settings.alarm_limits import monitored_alarms
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.raw_capture import make_header
from bms_estimator.sources.captures.recorder import CaptureRecorder
from bms_estimator.sources.factory import open_device
from bms_estimator.sources.serial.port_list import NoPortError, PortBusyError, open_port, resolve_port
from bms_estimator.sources.serial.serial_source import SerialSource
from bms_estimator.sources.source import LineSource

CUTOFF_MARGIN_V = 0.02
"""Distance per cell between the limits of the test and the alarms, and between mean and single cells without alarms [V]."""
DEFAULT_TAIL_C_RATE = 0.05
"""Charge current at which a charge ends by default, as a C-rate [1/h]."""
DEFAULT_MAX_TEMPERATURE_C = 60.0
"""Maximum temperature of a pack without an alarm for high temperature [°C]. Most cells may be discharged up to it."""


def pack_limits(settings: Settings, pack: CellModel) -> Limits:
    """Return the limits of a pack, none of them beyond its alarms.

    Args:
        settings: Settings of the pack.
        pack: Model of the whole pack.
    """
    cells, charge = pack.cell.series_count, settings.pack.charge_limits
    alarms = {alarm.name: alarm.limit for alarm in monitored_alarms(settings, pack)}
    grid_v = ocv_grid(pack)[0]
    margin_v = CUTOFF_MARGIN_V * cells
    min_cutoff_v = alarms["pack_under_voltage"] + margin_v if "pack_under_voltage" in alarms else float(grid_v[0])
    full_v = min(charge.full_voltage_v or float(grid_v[-1]), alarms.get("pack_over_voltage", math.inf))
    cutoff_v = max(charge.cutoff_voltage_v or 0.0, min_cutoff_v)
    return Limits(
        capacity_ah=pack.cell.capacity_ah,
        series_count=cells,
        full_v=full_v,
        tail_a=charge.tail_current_a or DEFAULT_TAIL_C_RATE * pack.cell.capacity_ah,
        cutoff_v=cutoff_v,
        min_cell_v=alarms.get("cell_under_voltage", cutoff_v / cells - CUTOFF_MARGIN_V) + CUTOFF_MARGIN_V,
        max_cell_v=alarms.get("cell_over_voltage", full_v / cells + CUTOFF_MARGIN_V),
        max_discharge_a=power_limits(settings, pack).discharge_a,
        max_temperature_c=alarms.get("over_temperature", DEFAULT_MAX_TEMPERATURE_C),
    )


CHART_WIDTH, CHART_HEIGHT = 50, 10
"""Size of the chart without its labels [characters]."""
BAR_WIDTH = 40
"""Width of the progress bar [characters]."""


def build_screen(test: GuidedTest, silence_reason: str | None) -> RenderableType:
    """Return the screen.

    Args:
        test: The test in progress.
        silence_reason: Reason why no samples arrive; None while they arrive.
    """
    lines: list[RenderableType] = [Text(test.instruction, style="bold cyan")]
    warnings = (silence_reason, test.restart_reason, test.warning)
    lines += [Text(warning, style="bold yellow") for warning in warnings if warning]
    lines += [
        Text(measured_text(test), style="dim"),
        _progress_line(test),
        Text(remaining_text(test)),
    ]
    if test.points:
        lines += ["", *chart(test.points)]
    return Group(*lines)


def _progress_line(test: GuidedTest) -> Table:
    line = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=1.0, completed=test.progress, width=BAR_WIDTH)
    line.add_row(bar, f"{100.0 * test.progress:.0f} %")
    return line


def instruction_text(test: GuidedTest) -> str:
    """Return the instruction, with the warnings about it."""
    return " ".join(filter(None, (test.restart_reason, test.instruction, test.warning)))


def measured_text(test: GuidedTest) -> str:
    """Return the phase and the measured values."""
    phase = test.phase.value
    if test.phase in (Phase.DISCHARGE, Phase.REST):
        phase += f" {test.discharge_number} of about {test.expected_discharges}"
    now = test.latest
    if now is None:
        return f"{phase}; no sample yet"
    return f"{phase}; {now.voltage_v:.3f} V, {now.current_a:+.2f} A, {test.drawn_ah:z.2f} Ah drawn"


def remaining_text(test: GuidedTest) -> str:
    """Return the remaining time and what it is estimated from."""
    minutes = round(test.remaining_s / 60.0)
    duration = f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
    return f"about {duration} left, {test.remaining_basis}"


def chart(points: Sequence[OcvPoint]) -> list[str]:
    """Return the lines of a chart of voltage over SOC 0..1."""
    low_v, high_v = min(each.voltage_v for each in points), max(each.voltage_v for each in points)
    span_v = max(high_v - low_v, 1e-3)
    grid = [[" "] * CHART_WIDTH for _ in range(CHART_HEIGHT)]
    for each in points:
        column = round(min(max(each.soc, 0.0), 1.0) * (CHART_WIDTH - 1))
        row = round((high_v - each.voltage_v) / span_v * (CHART_HEIGHT - 1))
        grid[row][column] = "•"
    labels = {0: f"{high_v:.3f} V", CHART_HEIGHT - 1: f"{low_v:.3f} V"}
    rows = [f"{labels.get(i, ''):>10} │{''.join(row)}" for i, row in enumerate(grid)]
    axis = f"{'':>10} └{'─' * CHART_WIDTH}"
    return [*rows, axis, f"{'':>11}0 %{'SOC':^{CHART_WIDTH - 7}}100 %"]


REDRAW_S = 0.5
"""Interval between two updates of the screen [s]."""
STALE_S = 5.0
"""Age of the last samples at which a relay disconnects the load [s]."""


@dataclass(frozen=True)
class RelayOptions:
    """Relay that switches the load.

    Attributes:
        level: Level of the board's relay pin that connects the load, ``high`` or ``low``; None: the board has no relay.
        program: Function that switches the load with a program; None: no program.
        silent_s: Time without a command after which the board disconnects the load by itself [s].
    """

    level: str | None
    program: SetLoad | None
    silent_s: int


def run_guided_test(settings: Settings, pack: CellModel, session: Session, relay: RelayOptions) -> Columns | None:
    """Run a guided test of a connected pack, or continue an interrupted one.

    Returns:
        The capture of the finished test, from the rest of the full pack on; None if a signal ended the test.

    Raises:
        UserError: The source, the relay or the recording cannot be used.
    """
    has_relay = bool(relay.level or relay.program)
    test = GuidedTest(PLANS[session.plan], pack_limits(settings, pack), relay=has_relay)
    samples, last_arrival_s = join_recordings(session.paths, settings.sensor)
    test.feed(samples)
    if not test.is_done:
        _check_port(settings)
        end_s = float(samples["time_s"][-1]) if samples.size else 0.0
        session, path = session.with_next_recording()
        with CaptureRecorder(path, make_header(settings.sensor, settings.source)) as recording:
            live = _LiveTest(settings, test, recording, relay, end_s, last_arrival_s)
            asyncio.run(live.run())
        if recording.fault:
            raise UserError(f"{path}: recording ended: {recording.fault}")
        if not test.is_done:
            return None
        samples, _ = join_recordings(session.paths, settings.sensor)
    means = means_of_windows(samples[samples["time_s"] >= test.begin_s])
    return Columns(means, f"{session.stem}, {session.plan} test")


def _check_port(settings: Settings) -> None:
    """Check that no other program reads the serial port. A port that does not exist yet is awaited later.

    Raises:
        UserError: Another program, such as the service of the pack, has the port open.
    """
    if settings.source is not None:
        return
    try:
        open_port(resolve_port(settings.sensor.port), settings.sensor.baud).close()
    except PortBusyError as error:
        raise UserError(f"{error}; end that program first, because a serial port serves only one program") from None
    except NoPortError:
        return


class _LiveTest:
    """Guided test that runs on the live samples of a source.

    Args:
        settings: Settings of the pack.
        test: The test, after the samples of earlier recordings.
        recording: Receives the bytes of the source.
        relay: Relay that switches the load.
        end_s: Time of the last sample in earlier recordings, on the test's clock [s].
        last_arrival_s: Arrival time of that sample [s since 1970]; NaN without such a sample.
    """

    def __init__(
        self,
        settings: Settings,
        test: GuidedTest,
        recording: CaptureRecorder,
        relay: RelayOptions,
        end_s: float,
        last_arrival_s: float,
    ) -> None:
        self._settings, self._test, self._recording, self._relay = settings, test, recording, relay
        self._end_s, self._last_arrival_s = end_s, last_arrival_s
        self._has_samples, self._done = asyncio.Event(), asyncio.Event()
        self._last_block_s = -math.inf  # monotonic time of the last block
        self._switch: LoadSwitch | None = None

    async def run(self) -> None:
        """Run until the test ends, a signal arrives, or the disk fails. The load is disconnected at the end."""
        stop = stop_on_signal()
        console, log = Console(stderr=True), deque[str]()
        configure_logs(log if console.is_terminal else None)
        source = open_device(self._settings, tap=self._recording)
        self._switch = self._make_switch(source)
        async with source:
            # relay commands need a task that reads, so that reading ends last
            reading = asyncio.create_task(self._read(source))
            try:
                await until_first_ends(
                    stop.wait(),
                    self._done.wait(),
                    asyncio.wait([reading]),  # waits without cancelling the task
                    self._recording.wait_for_end(),
                    self._drive_switch(),
                    self._show(console, source, log),
                )
                if reading.done():
                    reading.result()
            finally:
                try:
                    if self._switch:
                        await self._switch.release()
                finally:
                    await end_tasks(reading)

    def _make_switch(self, source: SerialSource | LineSource) -> LoadSwitch | None:
        """Return the switch of the load; None without a relay.

        Raises:
            UserError: The device has no relay.
        """
        if self._relay.program:
            return LoadSwitch(self._relay.program, repeat=False)
        if not self._relay.level:
            return None
        if source.relay is None or self._settings.sensor.protocol != "binary":
            raise UserError("--relay: only the firmware's board has a relay; use --relay-command for another one")
        high_is_on = self._relay.level == "high"
        return LoadSwitch(board_relay(source.relay, high_is_on=high_is_on, silent_s=self._relay.silent_s), repeat=True)

    async def _read(self, source: SerialSource | LineSource) -> None:
        """Advance the test by all samples of the source."""
        shift_s = math.nan
        async for received in source:
            samples = received.samples.copy()
            if math.isnan(shift_s):
                shift_s = start_time(self._end_s, self._last_arrival_s, time.time()) - float(samples["time_s"][0])
            samples["time_s"] += shift_s
            self._test.feed(samples, received.cells_v)
            self._last_block_s = time.monotonic()
            self._has_samples.set()
            self._request_load()
            if self._test.is_done:
                self._done.set()
            await asyncio.sleep(0)  # a source that always has samples must not starve the other tasks

    def _request_load(self) -> None:
        """Request the state of the load; it is disconnected if no samples arrive."""
        is_fresh = time.monotonic() - self._last_block_s < STALE_S
        if self._switch:
            self._switch.request(self._test.load_on and is_fresh)

    async def _drive_switch(self) -> None:
        """Send the state of the load from the first samples on."""
        await self._has_samples.wait()
        if self._switch is None:
            await asyncio.Event().wait()
        else:
            await self._switch.run()

    async def _show(self, console: Console, source: SerialSource | LineSource, log: deque[str]) -> None:
        """Show the screen on a terminal, otherwise a line whenever the instruction changes."""
        printed_text = ""
        with Live(console=console, auto_refresh=False, transient=True) as live:
            while True:
                self._request_load()
                while log:
                    console.print(Text.from_ansi(log.popleft()))
                if console.is_terminal:
                    live.update(build_screen(self._test, source.silence_reason), refresh=True)
                elif (text := instruction_text(self._test)) != printed_text:
                    printed_text = text
                    line = f"{text} [{measured_text(self._test)}; {remaining_text(self._test)}]"
                    console.print(line, markup=False, soft_wrap=True)
                await asyncio.sleep(REDRAW_S)
