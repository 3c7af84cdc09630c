"""How a snapshot looks on a terminal: pure functions from values to renderables.

A large terminal gets two columns of panels, on a smaller one everything flows in one. On a low screen the least
important parts are left out: SOC with its band, voltage, current and what is wrong go last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bms_estimator.model.estimate import Estimate, Health, Parameter, ParameterReport, Snapshot
from bms_estimator.sinks.console_fit import Block, Flow, fitted

WIDE_CELLS, WIDE_LINES = 76, 18
"""Two columns of panels need so much room."""
PANEL_CELLS = 4
"""Of its border and padding."""
VALUE_CELLS = 8
"""Numbers change their length; columns must not dance."""
SPARKS = "▁▂▃▄▅▆▇█"
LOG_LINES = 2
NARROW_MARGIN = 0.05
"""A stability margin below is shown as a warning."""
LOW_SOC = 0.2
BAND_STDS = 2.0
"""Of the band around the SOC: it holds the truth 19 times out of 20."""

ELEMENT_UNITS = {
    "r_s_ohm": ("R_s", 1e3, "mΩ"),
    "r_ts_ohm": ("R_ts", 1e3, "mΩ"),
    "c_ts_farad": ("C_ts", 1.0, "F"),
    "r_tl_ohm": ("R_tl", 1e3, "mΩ"),
    "c_tl_farad": ("C_tl", 1.0, "F"),
    "e_o_v": ("E_o", 1.0, "V"),
    "r_ohm": ("r", 1e3, "mΩ"),
    "tafel_slope_v": ("A", 1.0, "V"),
    "exchange_current_a": ("i_0", 1e3, "mA"),
    "c_dl_farad": ("C", 1.0, "F"),
    "concentration_v": ("B", 1.0, "V"),
    "limiting_current_a": ("i_L", 1.0, "A"),
    "internal_current_a": ("i_n", 1e3, "mA"),
}
"""Element -> name, factor and unit on the screen."""
WORN = {"capacity": "capacity", "r_s": "R_s"}
"""What tells of wear -> name on the screen."""


@dataclass(frozen=True)
class Scene:
    """All that is shown at one moment."""

    snapshot: Snapshot
    """What was published last."""
    latest: Estimate | None
    """The last estimate there was; the snapshot's may be missing."""
    voltage_v: Sequence[float] = ()
    """Voltages of the last publications, oldest first."""
    current_a: Sequence[float] = ()
    """Currents of the same."""
    log: Sequence[str] = ()
    """Log lines, the last ones are shown; ANSI colours allowed."""
    hint: str = ""
    """The last line."""
    true_soc: float | None = None
    """SOC 0..1 of a simulated pack at the last sample."""


def line(scene: Scene) -> str:
    """One line for a file or a pipe."""
    snapshot = scene.snapshot
    e, device = snapshot.estimate, snapshot.info.device
    if e is None:
        return f"{snapshot.health.publish_time} {device}: {snapshot.health.sensor_message or 'no sample'}"
    truth = "" if scene.true_soc is None else f"  true {100.0 * scene.true_soc:.2f} %"
    return (
        f"{e.time} {device}: soc {_number(e.soc_percent, '.2f')}{_band_text(e)} %{truth}  "
        f"{e.voltage_v:.3f} V  {e.current_a:+.3f} A  {e.power_w:+.2f} W  margin {_number(e.stability_margin, '.4f')}  "
        f"delta1 {_number(e.delta_1, '.4f')}  delta2 {_number(e.delta_2, '.4f')}  "
        f"N {_number(e.nussbaum_gain, '.4f')}  k {_number(e.adaptive_gain_k, '.3g')}  "
        f"innovation {_number(e.innovation_v, '+.2f', 1e3)} mV  {'lock' if e.lock else 'NO LOCK'}  "
        f"{'converged' if e.converged else 'converging'}  frames {e.frames_received}  lost {e.frames_lost}"
    )


class View:
    """The whole screen."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Rich's protocol: as wide and at most as high as the options say."""
        wide = options.max_width >= WIDE_CELLS and options.max_height >= WIDE_LINES
        yield from fitted(_blocks(self._scene, options.max_width, wide=wide), console, options)


def _blocks(scene: Scene, width: int, *, wide: bool) -> list[Block]:
    """The parts of the screen from top to bottom, each with its rank."""
    snapshot, e = scene.snapshot, scene.latest
    charge = _charge(scene, width - PANEL_CELLS if wide else width) if snapshot.info.capacity_ah is not None else []
    health = Block(0, _health(snapshot.health, snapshot.parameters))
    below = [
        Block(5, _observer(e)),
        Block(6, _link(e, snapshot.health)),
        Block(9, _log(scene.log)),
        Block(2, Text(scene.hint, style="cyan")),
    ]
    header, elements = Block(1, _header(snapshot, wide=wide)), _elements(snapshot.parameters.elements)
    if not wide:
        sparks = Block(7, _sparks(scene, width))
        return [header, *charge, Block(0, Flow(*_measured(e))), health, sparks, Block(8, elements), *below]
    columns = Table.grid(expand=True)
    columns.add_column(ratio=1)
    columns.add_column(ratio=1)
    left = Group(*_measured(e, VALUE_CELLS), _sparks(scene, width // 2 - PANEL_CELLS))
    columns.add_row(_panel(left, "Measured"), _panel(elements, "Elements at this SOC" if charge else "Learned"))
    soc = [Block(0, _panel(Group(*(block.content for block in charge)), "State of charge"))] if charge else []
    return [header, *soc, health, Block(0, columns), *below]


def _charge(scene: Scene, cells: int) -> list[Block]:
    """What a battery holds."""
    e = scene.latest
    return [Block(0, _soc(e, scene.true_soc)), Block(4, _bar(e, scene.true_soc, cells)), Block(3, _left(e))]


def sparkline(values: Sequence[float], cells: int) -> str:
    """The last ``cells`` values as blocks from their lowest to their highest."""
    shown = values[-cells:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    scale = (len(SPARKS) - 1) / (high - low) if high > low else 0.0
    return "".join(SPARKS[round((value - low) * scale)] for value in shown)


def _header(snapshot: Snapshot, *, wide: bool) -> RenderableType:
    info, health = snapshot.info, snapshot.health
    left = Text.assemble((f" {info.device} ", "bold reverse"), overflow="ellipsis")
    if wide:
        holds = "" if info.capacity_ah is None else f", {info.capacity_ah:.4g} Ah"
        cells = f"{info.series_count} cell{'s' if info.series_count > 1 else ''}"
        left += Text(f"  {info.cell}, {cells} in series, {info.nominal_voltage_v:.4g} V{holds}")
    state = Text("● live", style="bold green") if health.sensor_online else Text("● stale", style="bold red")
    row = Table.grid(expand=True)
    row.add_column(no_wrap=True)
    row.add_column(justify="right", no_wrap=True)
    row.add_row(left, state + Text(f"  {health.publish_time[11:19]}Z", style="dim"))
    return row


def _soc(e: Estimate | None, true_soc: float | None) -> Flow:
    """The estimate with its band; beside it the truth, where it is known."""
    soc = e.soc if e else None
    texts = [
        Text.assemble(("SOC ", "dim"), (f"{_number(soc, '.2%')}{_band_text(e, '%')}", "bold"), (" (2 std)", "dim"))
    ]
    if true_soc is not None:
        texts.append(Text.assemble(("true ", "dim"), (f"{true_soc:.2%}", "bold magenta")))
        if soc is not None:
            texts.append(Text.assemble(("error ", "dim"), f"{soc - true_soc:+.2%}"))
    return Flow(*texts)


def _bar(e: Estimate | None, true_soc: float | None, cells: int) -> Text:
    """Filled to the SOC, its band hatched, a tick where the truth is."""
    soc = e.soc if e and e.soc is not None else 0.0
    band = BAND_STDS * e.soc_std if e and e.soc_std is not None else 0.0
    colour = "green" if soc > LOW_SOC else "yellow"

    def part(cell: int) -> tuple[str, str]:
        low, high = cell / cells, (cell + 1) / cells
        if true_soc is not None and low <= true_soc < high:
            return "┃", "bold magenta"
        if band > 0.0 and low < soc + band and high > soc - band:
            return "▒", colour
        return ("█", colour) if high <= soc else ("░", "bright_black")

    parts = groupby(part(cell) for cell in range(cells))
    return Text.assemble(*((mark * len(list(same)), style) for (mark, style), same in parts))


def _left(e: Estimate | None) -> Flow:
    """What is left, and how long it lasts."""
    seconds = e.time_to_empty_s if e else None
    lasts = "empty in - : no load" if seconds is None else f"empty in {_duration(seconds)} at this load"
    ah, wh = (e.remaining_capacity_ah, e.remaining_energy_wh) if e else (None, None)
    return Flow(Text(lasts), Text(f"{_number(ah, '.3f')} Ah"), Text(f"{_number(wh, '.2f')} Wh left"))


def _measured(e: Estimate | None, cells: int = 0) -> list[Text]:
    """Means of the publish window, each number right-aligned in ``cells``."""
    v, i, p, t = (e.voltage_v, e.current_a, e.power_w, e.temperature_c) if e else (None,) * 4
    way = "" if i is None else " discharge" if i > 0.0 else " charge" if i < 0.0 else ""
    return [
        Text.assemble((f"{_number(v, '.3f'):>{cells}}", "bold"), (" V", "dim")),
        Text.assemble((f"{_number(i, '+.3f'):>{cells}}", "bold"), (f" A{way}", "dim")),
        Text.assemble(f"{_number(p, '+.2f'):>{cells}}", (" W", "dim")),
        Text.assemble(f"{_number(t, '.1f'):>{cells}}", (" °C", "dim")),
    ]


def _sparks(scene: Scene, width: int) -> Text:
    """How voltage and current went over the last publications."""
    cells = width - 2
    voltage, current = sparkline(scene.voltage_v, cells), sparkline(scene.current_a, cells)
    return Text.assemble(("V ", "dim"), (voltage, "cyan"), ("\nA ", "dim"), (current, "magenta"))


def _elements(elements: dict[str, Parameter]) -> Table:
    """Each element with its standard deviation and where it comes from; bold where it is valid."""
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(justify="right", no_wrap=True, min_width=VALUE_CELLS)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(style="dim", no_wrap=True)
    for key, parameter in elements.items():
        name, factor, unit = ELEMENT_UNITS[key]
        std = "" if parameter.std is None else f"± {_short(parameter.std * factor)} "
        value = Text(_number(parameter.value, ".4g", factor), style="bold" if parameter.valid else "")
        table.add_row(name, value, f"{std}{unit}", parameter.source)
    return table


def _health(health: Health, parameters: ParameterReport) -> Flow:
    """What is wrong, in full; else how worn the pack is."""
    wrong = [Text(health.sensor_message, style="bold red")] if health.sensor_message else []
    wrong += [Text(f"suspected: {suspect}", style="bold yellow") for suspect in health.suspects]
    if wrong:
        return Flow(*wrong)
    worn = parameters.state_of_health.items()
    known = [
        f"{WORN[name]} {p.value:.2f} ± {p.std:.2f} of new"
        for name, p in worn
        if name in WORN and p.valid and p.value and p.std
    ]
    return Flow(Text.assemble(("health ", "dim"), ("good", "bold green")), *map(Text, known))


def _observer(e: Estimate | None) -> Flow:
    """The thesis's observer: where its model stays stable, its gain, and whether it tracks."""
    margin = e.stability_margin if e else None
    narrow = margin is not None and margin < NARROW_MARGIN
    return Flow(
        Text.assemble(("observer ", "dim"), ("lock", "green") if e and e.lock else ("NO LOCK", "bold red")),
        Text(f"δ1 {_number(e.delta_1 if e else None, '.4f')}"),
        Text(f"δ2 {_number(e.delta_2 if e else None, '.4f')}"),
        Text(f"margin {_number(margin, '.4f')}", style="bold red" if narrow else ""),
        Text(f"N {_number(e.nussbaum_gain if e else None, '.4f')}"),
        Text(f"k {_number(e.adaptive_gain_k if e else None, '.3g')}"),
    )


def _link(e: Estimate | None, health: Health) -> Flow:
    """The line and the service; faults are red."""
    dropped = sum(count for name, count in health.samples.items() if name.startswith("dropped_"))
    counts = {
        "frames lost": health.line.get("frames_lost", 0),
        "CRC errors": health.line.get("crc_errors", 0),
        "samples dropped": dropped,
        "reconnects": health.reconnects,
        "lock losses": health.lock_losses,
    }
    faults = [Text(f"{count:,} {name}", style="bold red") for name, count in counts.items() if count]
    return Flow(
        Text.assemble(("link ", "dim"), f"{health.line.get('frames_received', 0):,} frames"),
        Text(f"{_number(e.sample_rate_hz if e else None, '.1f')} Hz"),
        *(faults or [Text("no faults")]),
        Text(f"up {health.uptime_s:,.0f} s"),
        Text(f"{_number(health.rss_mib, '.0f')} MiB"),
    )


def _log(entries: Sequence[str]) -> Text:
    text = Text("\n").join(Text.from_ansi(entry) for entry in entries[-LOG_LINES:])
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _panel(content: RenderableType, title: str) -> Panel:
    return Panel(content, title=title, title_align="left", box=box.ROUNDED, border_style="dim")


def _band_text(e: Estimate | None, unit: str = "") -> str:
    return "" if e is None or e.soc_std is None else f" ± {100.0 * BAND_STDS * e.soc_std:.2f}{unit}"


def _duration(seconds: float) -> str:
    """Hours and minutes, or minutes."""
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02} min"


def _short(value: float) -> str:
    """Two digits, in full from a hundred on."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:{form}}"
