"""Screen of the terminal view: the pack's values, alarms and faults, the last log lines and a hint. No I/O."""

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from bms_estimator.sinks.terminal.json_fields import JsonFields
from bms_estimator.sinks.terminal.view_state import PackView, ViewState, clock_text, cutoff_band_text, soc_text

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
    for entry in view.log[-LOG_LINES:]:
        line = Text.from_ansi(entry)
        line.no_wrap, line.overflow = True, "ellipsis"
        lines.append(line)
    return Group(*lines, Text(view.hint, style="cyan"))


def _pack_table(view: ViewState, pack: PackView, width: int) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    table.width = MIN_TABLE_CELLS if width < MIN_TABLE_CELLS else None
    table.add_column("Pack", overflow="fold")
    table.add_column("SOC %\n± 2 std", no_wrap=True, style="bold")
    if view.true_soc is not None:
        table.add_column("True\nSOC %", no_wrap=True, style="magenta")
    table.add_column(f"State at\n{clock_text(view.now_s)}", no_wrap=True)
    is_wide = width >= MIN_WIDE_TABLE_CELLS
    remaining = ("Remaining\nAh",) if is_wide else ()
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
