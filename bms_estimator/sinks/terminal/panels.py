"""Views of published payloads for a terminal: pure functions from payloads to renderables.

A large terminal gets two columns of panels, on a smaller one everything flows in one. On a low screen the least
important parts are omitted; SOC with its band, voltage, current, alarms and errors stay longest.
"""

from collections.abc import Sequence
from itertools import groupby

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bms_estimator.model.clock import iso_utc
from bms_estimator.sinks.terminal.json_fields import JsonFields
from bms_estimator.sinks.terminal.layout import FlowLayout, LayoutBlock, fitted
from bms_estimator.sinks.terminal.scene import ScreenState

WIDE_CELLS, WIDE_LINES = 76, 18
"""Minimum size for two columns of panels."""
PANEL_CELLS = 4
"""Width of a panel's border and padding."""
VALUE_CELLS = 8
"""Numbers change their length; columns must not dance."""
SPARKS = "▁▂▃▄▅▆▇█"
LOG_LINES = 2
"""The last of the log, which the screen hides."""
MAX_ALARMS = 4
"""Maximum number of alarms shown in full."""
MAX_PACKS = 8
"""Maximum number of packs listed, around the shown one."""
NARROW_MARGIN = 0.05
"""A stability margin below is shown as a warning."""
LOW_SOC = 0.2
BAND_STDS = 2.0
"""Half width of the band around the SOC in std: it holds the ground truth 19 times out of 20."""

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
"""Names on the screen of quantities that show wear."""
COUNTED = {"lock_losses": "lock losses", "reconnects": "reconnects"}
"""Fault counter of the health -> name on the screen."""


class Screen:
    """The whole screen."""

    def __init__(self, scene: ScreenState) -> None:
        self._scene = scene

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Rich's protocol: as wide and at most as high as the options."""
        wide = options.max_width >= WIDE_CELLS and options.max_height >= WIDE_LINES
        yield from fitted(_blocks(self._scene, options.max_width, wide=wide), console, options)


def _blocks(scene: ScreenState, width: int, *, wide: bool) -> list[LayoutBlock]:
    """Return the parts of the screen from top to bottom, each with its rank."""
    hint = LayoutBlock(2, Text(scene.hint, style="cyan"))
    packs = [LayoutBlock(1, _packs(scene))] if len(scene.packs) > 1 else []
    if not scene.device:
        return [
            LayoutBlock(0, _header(scene, wide=wide)),
            LayoutBlock(0, Text("no pack has published anything yet")),
            hint,
        ]
    state, health, parameters = scene.state, scene.health, scene.parameters
    charge = [] if scene.has_no_charge else _charge(scene, width - PANEL_CELLS if wide else width)
    wrong = [LayoutBlock(0, _alarms(scene.alarms)), LayoutBlock(0, _health(health, parameters))]
    below = [
        LayoutBlock(4, _cells(state)),
        LayoutBlock(5, _energy(state)),
        LayoutBlock(5, _observer(state)),
        LayoutBlock(6, _link(state, health)),
        LayoutBlock(9, _log(scene.log)),
        hint,
    ]
    header, elements = LayoutBlock(1, _header(scene, wide=wide)), _elements(parameters.fields("elements"))
    if not wide:
        sparks = LayoutBlock(7, _sparks(scene, width))
        parts = [
            header,
            *packs,
            *charge,
            LayoutBlock(0, FlowLayout(*_measured(state))),
            *wrong,
            sparks,
            LayoutBlock(8, elements),
            *below,
        ]
        return _shown(parts)
    columns = Table.grid(expand=True)
    columns.add_column(ratio=1)
    columns.add_column(ratio=1)
    left = Group(*_measured(state, VALUE_CELLS), _sparks(scene, width // 2 - PANEL_CELLS))
    columns.add_row(_panel(left, "Measured"), _panel(elements, "Elements at this SOC" if charge else "Learned"))
    soc = [LayoutBlock(0, _panel(Group(*(block.content for block in charge)), "State of charge"))] if charge else []
    return _shown([header, *packs, *soc, *wrong, LayoutBlock(0, columns), *below])


def _shown(blocks: Sequence[LayoutBlock]) -> list[LayoutBlock]:
    """Return the parts that are not empty."""
    return [block for block in blocks if not (isinstance(block.content, FlowLayout) and block.content.is_empty())]


def _charge(scene: ScreenState, cells: int) -> list[LayoutBlock]:
    """Return the charge of a battery."""
    state = scene.state
    return [
        LayoutBlock(0, _soc(state, scene.true_soc)),
        LayoutBlock(4, _bar(state, scene.true_soc, cells)),
        LayoutBlock(3, _left(state)),
    ]


def sparkline(values: Sequence[float], cells: int) -> str:
    """Draw the last ``cells`` values as blocks from their minimum to their maximum."""
    shown = values[-cells:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    scale = (len(SPARKS) - 1) / (high - low) if high > low else 0.0
    return "".join(SPARKS[round((value - low) * scale)] for value in shown)


def _packs(scene: ScreenState) -> Table:
    """All packs, a line each, around the one that is shown below."""
    names = [pack.device for pack in scene.packs]
    first = max(min(names.index(scene.device) - MAX_PACKS // 2, len(names) - MAX_PACKS), 0)
    table = Table.grid(padding=(0, 2))
    for pack in scene.packs[first : first + MAX_PACKS]:
        here = pack.device == scene.device
        stale, alarms = pack.stale, len(pack.alarms)
        table.add_row(
            Text(f"{'▸' if here else ' '} {pack.device}", style="bold" if here else ""),
            f"{_number(pack.state.number('soc'), '.1%')}",
            f"{_number(pack.state.number('voltage_v'), '.2f')} V",
            f"{_number(pack.state.number('current_a'), '+.2f')} A",
            Text("stale" if stale else "live", style="red" if stale else "green"),
            Text(f"{alarms} alarm{'s' if alarms > 1 else ''}" if alarms else "", style="bold red"),
        )
    return table


def _header(scene: ScreenState, *, wide: bool) -> RenderableType:
    info = scene.info
    left = Text.assemble((f" {scene.device or 'no pack'} ", "bold reverse"), overflow="ellipsis")
    if wide and info:
        capacity, series = info.number("capacity_ah"), info.count("series_count")
        holds = "" if capacity is None else f", {capacity:.4g} Ah"
        nominal = _number(info.number("nominal_voltage_v"), ".4g")
        left += Text(f"  {info.text('cell')}, {series} cell{'s' if series > 1 else ''} in series, {nominal} V{holds}")
    state = Text(f"● {scene.stale}", style="bold red") if scene.stale else Text("● live", style="bold green")
    row = Table.grid(expand=True)
    row.add_column(no_wrap=True)
    row.add_column(justify="right", no_wrap=not scene.stale)
    row.add_row(left, state + Text(f"  {iso_utc(scene.now_s)[11:19]}Z", style="dim"))
    return row


def _soc(state: JsonFields, true_soc: float | None) -> FlowLayout:
    """Return the estimate with its band, and the ground truth if known."""
    soc = state.number("soc")
    texts = [
        Text.assemble(("SOC ", "dim"), (f"{_number(soc, '.2%')}{band_text(state, '%')}", "bold"), (" (2 std)", "dim"))
    ]
    if true_soc is not None:
        texts.append(Text.assemble(("true ", "dim"), (f"{true_soc:.2%}", "bold magenta")))
        if soc is not None:
            texts.append(Text.assemble(("error ", "dim"), f"{soc - true_soc:+.2%}"))
    return FlowLayout(*texts)


def _bar(state: JsonFields, true_soc: float | None, cells: int) -> Text:
    """Draw a bar filled to the SOC, with a hatched band and a tick at the ground truth."""
    soc, band = state.number("soc") or 0.0, BAND_STDS * (state.number("soc_std") or 0.0)
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


def _left(state: JsonFields) -> FlowLayout:
    """Return the remaining charge and time."""
    empty_s, full_s = state.number("time_to_empty_s"), state.number("time_to_full_s")
    lasts = "empty in - : no load"
    if empty_s is not None:
        lasts = f"empty in {_duration(empty_s)} at this load"
    elif full_s is not None:
        lasts = f"full in {_duration(full_s)} at this current"
    ah, wh = state.number("remaining_capacity_ah"), state.number("remaining_energy_wh")
    return FlowLayout(Text(lasts), Text(f"{_number(ah, '.3f')} Ah"), Text(f"{_number(wh, '.2f')} Wh left"))


def _measured(state: JsonFields, cells: int = 0) -> list[Text]:
    """Means of the publish window, each number right-aligned in ``cells``."""
    v, i = state.number("voltage_v"), state.number("current_a")
    p, t = state.number("power_w"), state.number("temperature_c")
    way = "" if i is None else " discharge" if i > 0.0 else " charge" if i < 0.0 else ""
    return [
        Text.assemble((f"{_number(v, '.3f'):>{cells}}", "bold"), (" V", "dim")),
        Text.assemble((f"{_number(i, '+.3f'):>{cells}}", "bold"), (f" A{way}", "dim")),
        Text.assemble(f"{_number(p, '+.2f'):>{cells}}", (" W", "dim")),
        Text.assemble(f"{_number(t, '.1f'):>{cells}}", (" °C", "dim")),
    ]


def _sparks(scene: ScreenState, width: int) -> Text:
    """Return sparklines of voltage and current over the last publications."""
    cells = width - 2
    voltage, current = sparkline(scene.voltage_v, cells), sparkline(scene.current_a, cells)
    return Text.assemble(("V ", "dim"), (voltage, "cyan"), ("\nA ", "dim"), (current, "magenta"))


def _elements(elements: JsonFields) -> Table:
    """Each element with its standard deviation and its source; bold where it is valid."""
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(justify="right", no_wrap=True, min_width=VALUE_CELLS)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(style="dim", no_wrap=True)
    for key in elements.names():
        if key not in ELEMENT_UNITS:
            continue
        name, factor, unit = ELEMENT_UNITS[key]
        parameter = elements.fields(key)
        std = parameter.number("std")
        spread = "" if std is None else f"± {_short(std * factor)} "
        value = _number(parameter.number("value"), ".4g", factor)
        style = "bold" if parameter.flag("valid") else ""
        table.add_row(name, Text(value, style=style), f"{spread}{unit}", parameter.text("source"))
    return table


def _alarms(alarms: Sequence[JsonFields]) -> FlowLayout:
    """Return raised and unmonitored alarms, the critical ones first."""
    worst = sorted(alarms, key=lambda alarm: alarm.text("severity") != "critical")
    texts = [
        Text(
            f"{alarm.text('severity')}: {alarm.text('text') or _unwatched(alarm)}",
            style="bold red" if alarm.text("severity") == "critical" else "bold yellow",
        )
        for alarm in worst[:MAX_ALARMS]
    ]
    more = len(worst) - len(texts)
    return FlowLayout(*texts, *([Text(f"and {more} more", style="bold red")] if more else []))


def _unwatched(alarm: JsonFields) -> str:
    """Return True for an alarm without a text, which cannot be monitored."""
    return f"{alarm.text('name')} cannot be raised: {alarm.text('unwatched_reason')}"


def _health(health: JsonFields, parameters: JsonFields) -> FlowLayout:
    """Return all faults; without any the pack's state of health."""
    message = health.text("sensor_message")
    wrong = [Text(message, style="bold red")] if message else []
    wrong += [Text(f"suspected: {suspect}", style="bold yellow") for suspect in health.texts("suspects")]
    if wrong or not health:
        return FlowLayout(*wrong)
    known = []
    for key, name in WORN.items():
        worn = parameters.fields("state_of_health").fields(key)
        value, std = worn.number("value"), worn.number("std")
        if worn.flag("valid") and value and std:
            known.append(Text(f"{name} {value:.2f} ± {std:.2f} of new"))
    return FlowLayout(Text.assemble(("health ", "dim"), ("good", "bold green")), *known)


def _cells(state: JsonFields) -> FlowLayout:
    """Single cells, where they are measured: how many, the lowest and the highest with their numbers."""
    low_v, high_v = state.number("cell_lowest_v"), state.number("cell_highest_v")
    if low_v is None or high_v is None:
        return FlowLayout()
    count = len(state.numbers("cells_v"))
    return FlowLayout(
        Text.assemble(("cells ", "dim"), str(count) if count else ""),
        Text(f"lowest {low_v:.3f} V{_cell(state, 'cell_lowest')}"),
        Text(f"highest {high_v:.3f} V{_cell(state, 'cell_highest')}"),
        Text(f"apart {1e3 * (high_v - low_v):.0f} mV"),
    )


def _cell(state: JsonFields, name: str) -> str:
    """Return a cell's number in brackets, if known."""
    number = state.number(name)
    return "" if number is None else f" (cell {number:.0f})"


def _energy(state: JsonFields) -> FlowLayout:
    """Return energy in and out since counting began."""
    out_kwh, in_kwh, cycles = (state.number(key) for key in ("energy_out_kwh", "energy_in_kwh", "equivalent_cycles"))
    if out_kwh is None or in_kwh is None:
        return FlowLayout()
    factor, unit = (1.0, "kWh") if max(out_kwh, in_kwh) >= 1.0 else (1e3, "Wh")
    counted = [
        Text.assemble(("energy ", "dim"), f"{factor * out_kwh:.2f} {unit} out"),
        Text(f"{factor * in_kwh:.2f} {unit} in"),
    ]
    return FlowLayout(*counted, *([] if cycles is None else [Text(f"{cycles:.1f} cycles")]))


def _observer(state: JsonFields) -> FlowLayout:
    """Return the thesis's observer: stability margin, gain, lock."""
    margin = state.number("stability_margin")
    narrow = margin is not None and margin < NARROW_MARGIN
    return FlowLayout(
        Text.assemble(("observer ", "dim"), ("lock", "green") if state.flag("lock") else ("NO LOCK", "bold red")),
        Text(f"δ1 {_number(state.number('delta_1'), '.4f')}"),
        Text(f"δ2 {_number(state.number('delta_2'), '.4f')}"),
        Text(f"margin {_number(margin, '.4f')}", style="bold red" if narrow else ""),
        _gain(state),
        Text(f"k {_number(state.number('adaptive_gain_k'), '.3g')}"),
    )


def _gain(state: JsonFields) -> Text:
    """N(k) of a printed law, gamma k of the learning law."""
    adaptation_hz = state.number("adaptation_gain_hz")
    if adaptation_hz is not None:
        return Text(f"gamma k {adaptation_hz:.4f}/s")
    return Text(f"N {_number(state.number('nussbaum_gain'), '.4f')}")


def _link(state: JsonFields, health: JsonFields) -> FlowLayout:
    """Return the state of line and service; faults are red."""
    line, samples = health.fields("line"), health.fields("samples")
    dropped = sum(samples.count(name) for name in samples.names() if name.startswith("dropped_"))
    counts = {
        "frames lost": line.count("frames_lost"),
        "CRC errors": line.count("crc_errors"),
        "samples dropped": dropped,
    } | {name: health.count(key) for key, name in COUNTED.items()}
    faults = [Text(f"{count:,} {name}", style="bold red") for name, count in counts.items() if count]
    return FlowLayout(
        Text.assemble(("link ", "dim"), f"{line.count('frames_received'):,} frames"),
        Text(f"{_number(state.number('sample_rate_hz'), '.1f')} Hz"),
        *(faults or [Text("no faults")]),
        Text(f"up {health.number('uptime_s') or 0.0:,.0f} s"),
        Text(f"{_number(health.number('rss_mib'), '.0f')} MiB"),
    )


def _log(entries: Sequence[str]) -> Text:
    text = Text("\n").join(Text.from_ansi(entry) for entry in entries[-LOG_LINES:])
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _panel(content: RenderableType, title: str) -> Panel:
    return Panel(content, title=title, title_align="left", box=box.ROUNDED, border_style="dim")


def band_text(state: JsonFields, unit: str = "") -> str:
    """`` ± 1.20%``, or nothing where no error is known."""
    std = state.number("soc_std")
    return "" if std is None else f" ± {100.0 * BAND_STDS * std:.2f}{unit}"


def _duration(seconds: float) -> str:
    """Hours and minutes, or minutes."""
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02} min"


def _short(value: float) -> str:
    """Two digits, in full from a hundred on."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:{form}}"
