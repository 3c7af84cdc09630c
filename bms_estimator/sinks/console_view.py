"""How a snapshot looks on a terminal of 80 x 24: pure functions from values to renderables."""

from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bms_estimator.model.estimate import Estimate, Health, Info, Parameter, Snapshot

BAR_CELLS = 60
SPARK_CELLS = 32
VALUE_CELLS = 9
"""Numbers change their length; columns must not dance."""
SPARKS = "▁▂▃▄▅▆▇█"
MESSAGE_LINES = 2
NARROW_MARGIN = 0.05
"""A stability margin below is shown as a warning."""
LOW_SOC = 0.2

ELEMENT_UNITS = {
    "r_s_ohm": ("R_s", 1e3, "mΩ"),
    "r_ts_ohm": ("R_ts", 1e3, "mΩ"),
    "c_ts_farad": ("C_ts", 1.0, "F"),
    "r_tl_ohm": ("R_tl", 1e3, "mΩ"),
    "c_tl_farad": ("C_tl", 1.0, "F"),
    "e_o_v": ("E_o", 1.0, "V"),
}
"""Element -> name, factor and unit on the screen."""


def view(
    snapshot: Snapshot,
    latest: Estimate | None,
    voltage_v: Sequence[float],
    current_a: Sequence[float],
    log: Iterable[str] = (),
    hint: str = "",
) -> RenderableType:
    """The whole screen.

    Args:
        snapshot: What was published last.
        latest: The last estimate there was; the snapshot's may be missing.
        voltage_v: Voltages of the last publications, oldest first.
        current_a: Currents of the same.
        log: The last log lines, ANSI colours allowed.
        hint: The last line.
    """
    grid = Table.grid(expand=True)
    grid.add_column(ratio=1)
    grid.add_column(ratio=1)
    grid.add_row(_measured(latest, voltage_v, current_a), _observer(latest, snapshot.info))
    grid.add_row(_elements(snapshot.parameters.elements), _link(latest, snapshot.health))
    return Group(_header(snapshot), _charge(latest), grid, _messages(snapshot.health, log, hint))


def line(snapshot: Snapshot) -> str:
    """One line for a file or a pipe."""
    e = snapshot.estimate
    if e is None:
        return f"{snapshot.health.publish_time} {snapshot.info.device}: {snapshot.health.sensor_message or 'no sample'}"
    return (
        f"{e.time} {snapshot.info.device}: soc {_number(e.soc_percent, '.2f')} %  {e.voltage_v:.3f} V  "
        f"{e.current_a:+.3f} A  {e.power_w:+.2f} W  margin {_number(e.stability_margin, '.4f')}  "
        f"delta1 {_number(e.delta_1, '.4f')}  delta2 {_number(e.delta_2, '.4f')}  "
        f"N {_number(e.nussbaum_gain, '.4f')}  k {_number(e.adaptive_gain_k, '.3g')}  "
        f"innovation {_number(e.innovation_v, '+.2f', 1e3)} mV  {'lock' if e.lock else 'NO LOCK'}  "
        f"{'converged' if e.converged else 'converging'}  frames {e.frames_received}  lost {e.frames_lost}"
    )


def sparkline(values: Sequence[float], cells: int = SPARK_CELLS) -> str:
    """The last ``cells`` values as blocks from their lowest to their highest."""
    shown = values[-cells:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    scale = (len(SPARKS) - 1) / (high - low) if high > low else 0.0
    return "".join(SPARKS[round((value - low) * scale)] for value in shown)


def gauge(fraction: float, cells: int, style: str, marks: Sequence[float] = ()) -> Text:
    """A bar filled to ``fraction`` 0..1, with red ticks at ``marks``."""
    filled = round(min(max(fraction, 0.0), 1.0) * cells)
    bar = Text("█" * filled, style=style) + Text("░" * (cells - filled), style="bright_black")
    for mark in marks:
        if 0.0 <= mark <= 1.0:
            place = min(int(mark * cells), cells - 1)
            bar = bar[:place] + Text("┃", style="bold red") + bar[place + 1 :]
    return bar


def _header(snapshot: Snapshot) -> RenderableType:
    info, health = snapshot.info, snapshot.health
    cells = f"{info.series_count} cell{'s' if info.series_count > 1 else ''}"
    left = Text.assemble(
        (f" {info.device} ", "bold reverse"),
        f"  {info.cell}, {cells} in series, {info.nominal_voltage_v:.4g} V, {info.capacity_ah:.4g} Ah",
        overflow="ellipsis",
    )
    state = Text("● live", style="bold green") if health.sensor_online else Text("● stale", style="bold red")
    row = Table.grid(expand=True)
    row.add_column(no_wrap=True)
    row.add_column(justify="right", no_wrap=True)
    row.add_row(left, state + Text(f"  {health.publish_time[11:19]}Z ", style="dim"))
    return row


def _charge(e: Estimate | None) -> Panel:
    """SOC with delta1 and delta2 marked in it, and the margin between."""
    rows = Table.grid(padding=(0, 1), expand=True)
    rows.add_column(width=6, style="dim", no_wrap=True)
    rows.add_column(width=BAR_CELLS, no_wrap=True)
    rows.add_column(justify="right", no_wrap=True)
    soc, margin = (e.soc, e.stability_margin) if e else (None, None)
    marks = [d for d in (e.delta_1, e.delta_2) if d is not None] if e else []
    colour = "green" if soc is not None and soc > LOW_SOC else "yellow"
    narrow = margin is None or margin < NARROW_MARGIN
    std = Text(f" ± {e.soc_std:.2%}", style="dim") if e and e.soc_std is not None else Text()
    rows.add_row("SOC", gauge(soc or 0.0, BAR_CELLS, colour, marks), Text(_number(soc, ".2%"), style="bold") + std)
    rows.add_row(
        "margin",
        gauge(margin or 0.0, BAR_CELLS, "red" if narrow else "cyan"),
        Text(_number(margin, ".4f"), style="bold red" if narrow else "bold"),
    )
    delta_1, delta_2 = (e.delta_1, e.delta_2) if e else (None, None)
    title = f"State of charge   δ1 {_number(delta_1, '.4f')}   δ2 {_number(delta_2, '.4f')}"
    return Panel(rows, title=title, title_align="left", box=box.ROUNDED, border_style="dim")


def _measured(e: Estimate | None, voltage_v: Sequence[float], current_a: Sequence[float]) -> Panel:
    """Means of the publish window; below, how voltage and current went over the last publications."""
    table = _rows()
    v, i, p, t = (e.voltage_v, e.current_a, e.power_w, e.temperature_c) if e else (None,) * 4
    way = "" if i is None else " discharge" if i > 0.0 else " charge" if i < 0.0 else ""
    table.add_row("voltage", _number(v, ".3f"), "V")
    table.add_row("current", _number(i, "+.3f"), "A" + way)
    table.add_row("power", _number(p, "+.2f"), "W")
    table.add_row("temperature", _number(t, ".1f"), "°C")
    sparks = Text.assemble(
        ("V ", "dim"), (sparkline(voltage_v), "cyan"), "\n", ("A ", "dim"), (sparkline(current_a), "magenta")
    )
    return _panel(Group(table, sparks), "Measured")


def _observer(e: Estimate | None, info: Info) -> Panel:
    table = _rows()
    estimate, innovation, gain, k = (
        (e.voltage_estimate_v, e.innovation_v, e.nussbaum_gain, e.adaptive_gain_k) if e else (None,) * 4
    )
    table.add_row("estimate", _number(estimate, ".3f"), "V")
    table.add_row("innovation", _number(innovation, "+.2f", 1e3), "mV")
    table.add_row("gain N(k)", _number(gain, ".4f"), "")
    table.add_row("k", _number(k, ".4g"), "V²s")
    table.add_row("state", _flag(e.lock if e else None, "lock", "NO LOCK"), "")
    table.add_row("", _flag(e.converged if e else None, "converged", "converging"), "")
    return _panel(table, f"Observer: {info.observer}")


def _elements(elements: dict[str, Parameter]) -> Panel:
    """Each element with its standard deviation and where it comes from; bold where it is valid."""
    table = _rows()
    table.add_column(style="dim", no_wrap=True)
    for key, (name, factor, unit) in ELEMENT_UNITS.items():
        parameter = elements.get(key)
        value = parameter.value if parameter else None
        known = parameter is not None and parameter.valid
        std = f"± {parameter.std * factor:.2g} " if parameter and parameter.std is not None else ""
        value_style = "bold" if known else ""
        table.add_row(
            name,
            Text(_number(value, ".4g", factor), style=value_style),
            f"{std}{unit}",
            parameter.source if parameter else "",
        )
    return _panel(table, "Elements at this SOC")


def _link(e: Estimate | None, health: Health) -> Panel:
    table = _rows()
    lost = health.line.get("frames_lost", 0)
    crc = health.line.get("crc_errors", 0)
    dropped = sum(count for name, count in health.samples.items() if name.startswith("dropped_"))
    table.add_row(
        "frames", f"{health.line.get('frames_received', 0):,}", f"{_number(e.sample_rate_hz if e else None, '.1f')} Hz"
    )
    table.add_row("lost, CRC", _bad(lost) + Text(", ") + _bad(crc), "")
    table.add_row("samples dropped", _bad(dropped), "")
    table.add_row("reconnects", _bad(health.reconnects), "")
    table.add_row("lock losses", _bad(health.lock_losses), "")
    table.add_row("up, memory", f"{health.uptime_s:,.0f}", f"s, {_number(health.rss_mib, '.0f')} MiB")
    return _panel(table, "Link and service")


def _messages(health: Health, log: Iterable[str], hint: str) -> Text:
    """Why values are stale or suspected, then the last of the log, then the hint."""
    why = [Text(f" {health.sensor_message}", style="bold red")] if health.sensor_message else []
    why += [Text(f" suspected: {suspect}", style="bold yellow") for suspect in health.suspects]
    lines = why + [Text.from_ansi(f" {entry}") for entry in list(log)[-max(MESSAGE_LINES - len(why), 1) :]]
    lines += [Text(f" {hint}", style="cyan")] if hint else []
    text = Text("\n").join(lines)
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _rows() -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(justify="right", no_wrap=True, min_width=VALUE_CELLS)
    table.add_column(style="dim", no_wrap=True)
    return table


def _panel(content: RenderableType, title: str) -> Panel:
    return Panel(content, title=title, title_align="left", box=box.ROUNDED, border_style="dim", height=8)


def _flag(value: bool | None, good: str, bad: str) -> Text:
    if value is None:
        return Text("-")
    return Text(good, style="bold green") if value else Text(bad, style="bold red")


def _bad(count: int) -> Text:
    return Text(f"{count:,}", style="bold red" if count else "")


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:{form}}"
