"""Report on a pack's stored history."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.plot.style import COLORS, FAINT, draw_band
from bms_estimator.plot.thinning import MAX_POINTS, thin
from bms_estimator.plot.time_series import label_time_axis, time_unit
from bms_estimator.reports.report_page import Group, Plot, ReportPage, Section
from bms_estimator.reports.svg_plot import small_plot

MINUTE_S = 60.0
"""Length of a row of the history [s]."""
GAP_S = 15 * 60.0
"""Interval between two rows above which no line connects them [s]. Shorter gaps are not visible over a day."""
MIN_POINTS = 30
"""Minimum number of points of a line between two gaps."""
DAY_S = 86_400.0
"""Length of a day [s]."""
MAX_DAYS = 62
"""Maximum number of days in the table. Older days are only in the figures."""
MAX_EVENTS = 100
"""Maximum number of events in the table; the latest ones are shown."""


@dataclass(frozen=True)
class PackHistory:
    """Stored history of a pack.

    Attributes:
        pack: Name of the pack.
        time_s: Shape (n,), start of each minute [s since 1970], increasing. A minute that passed twice, because the clock was
            set back, has a second row some seconds later.
        columns: Columns of ``store.minute.Minute`` by name, each of shape (n,); NaN where a value is missing.
        events: Time [s since 1970], name and text of each event, oldest first.
        learned: Name, value and std of each learned parameter in the last checkpoint; empty without a checkpoint.
        not_learned: Reason for which ``learned`` is empty; empty if it is not.
    """

    pack: str
    time_s: Floats
    columns: Mapping[str, Floats]
    events: Sequence[tuple[float, str, str]]
    learned: Sequence[tuple[str, str, str]]
    not_learned: str


def history_report(history: PackHistory, written: str) -> ReportPage:
    """Return the report on a pack's history, which has at least one row."""
    begin, end = _utc(history.time_s[0]), _utc(history.time_s[-1])
    events = [_events(history.events)] if history.events else []
    groups = [_over_time(history), _days(history), _learned(history), *events, _quality(history)]
    return ReportPage(
        title=f"{history.pack}: report on its history",
        subtitle=f"{begin} to {end}",
        grade="",
        sentences=tuple(_sentences(history)),
        sections=(Section("History", sentences=(), warnings=(), groups=tuple(groups)),),
        written=written,
    )


def _sentences(history: PackHistory) -> list[str]:
    """Return sentences on the SOC, the charge and the measured time of the pack."""
    columns = history.columns
    out_ah, in_ah = float(columns["charge_out_ah"].sum()), float(columns["charge_in_ah"].sum())
    days = (history.time_s[-1] + MINUTE_S - history.time_s[0]) / DAY_S
    sentences = []
    soc, std = _last(columns["soc"]), _last(columns["soc_std"])
    if np.isfinite(soc):
        band = f" ± {200 * std:.1f} % (2 std)" if np.isfinite(std) else ""
        sentences.append(f"The pack's SOC at the end is {100 * soc:.1f} %{band}.")
        sentences.append(
            f"In {days:.1f} days it ran between SOC {100 * np.nanmin(columns['soc']):.0f} % and "
            f"{100 * np.nanmax(columns['soc']):.0f} %."
        )
    sentences.append(f"{out_ah:.1f} Ah were drawn and {in_ah:.1f} Ah charged.")
    sentences.append(f"{100 * _measured_fraction(history):.1f} % of the time was measured.")
    return sentences


def _over_time(history: PackHistory) -> Group:
    figures: dict[str, Callable[[Any], None]] = {
        "SOC with ±2 std": lambda ax: _draw_soc(ax, history),
        "Voltage": lambda ax: _draw_range(ax, history, "voltage", "v", "voltage [V]", COLORS[0]),
        "Current": lambda ax: _draw_range(ax, history, "current", "a", "current [A], discharge > 0", COLORS[2]),
    }
    if np.isfinite(history.columns["temperature_c"]).any():
        figures["Temperature"] = lambda ax: _draw_range(ax, history, "temperature", "c", "temperature [°C]", COLORS[3])
    return Group(
        "Over time",
        tuple(Plot(title, small_plot(draw, salt=f"history-{title}")) for title, draw in figures.items()),
        remark=f"Time in UTC from {_utc(history.time_s[0])}. Bands of voltage, current and temperature are the extremes of each minute.",
    )


def _draw_soc(ax: Any, history: PackHistory) -> None:
    soc, std = 100.0 * history.columns["soc"], 200.0 * np.nan_to_num(history.columns["soc_std"])
    time, middle, low, high = _with_gaps(history.time_s, soc, (soc - std).clip(0.0), (soc + std).clip(max=100.0))
    draw_band(ax, time, low, high)
    ax.plot(time, middle, color=COLORS[0])
    label_time_axis(ax, history.time_s, "SOC [%]")


def _draw_range(ax: Any, history: PackHistory, quantity: str, unit: str, label: str, color: str) -> None:
    """Draw the mean of a quantity with the band of its extremes."""
    mean, low, high = (history.columns[f"{quantity}_{part}{unit}"] for part in ("", "min_", "max_"))
    time, mean, low, high = _with_gaps(history.time_s, mean, low, high)
    draw_band(ax, time, low, high, color=color)
    ax.plot(time, mean, color=color, linewidth=0.9)
    if quantity == "current":
        ax.axhline(0.0, color=FAINT, linewidth=0.8)
    label_time_axis(ax, history.time_s, label)


def _with_gaps(time_s: Floats, *curves: Floats) -> tuple[Floats, ...]:
    """Return thinned curves over the time in the unit of the axis, with NaN in each gap, so that no line crosses it."""
    ends = np.flatnonzero(np.diff(time_s) > GAP_S) + 1
    bounds = [0, *ends.tolist(), time_s.size]
    points = max(MAX_POINTS // len(bounds), MIN_POINTS)
    parts = []
    for first, last in itertools.pairwise(bounds):
        thinned = thin(time_s[first:last], *(curve[first:last] for curve in curves), points=points)
        parts.append([np.append(column, np.nan) for column in thinned])
    joined_s, *joined = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return ((joined_s - time_s[0]) / time_unit(time_s)[0], *joined)


def _days(history: PackHistory) -> Group:
    """Return the table of totals and extremes by day."""
    day = np.floor(history.time_s / DAY_S).astype(np.int64)
    rows = [_day_row(history, number, day == number) for number in np.unique(day)[-MAX_DAYS:]]
    return Group(
        "Days",
        columns=("day (UTC)", "SOC [%]", "V", "A", "°C", "Ah out", "Ah in", "kWh out", "kWh in", "measured"),
        rows=tuple(rows),
        remark="Ranges are minimum and maximum. Positive current discharges the pack.",
    )


def _day_row(history: PackHistory, number: int, rows: NDArray[np.bool_]) -> tuple[str, ...]:
    def column(name: str) -> Floats:
        return history.columns[name][rows]

    return (
        datetime.fromtimestamp(number * DAY_S, UTC).strftime("%Y-%m-%d"),
        _range(100.0 * column("soc"), 100.0 * column("soc"), 0),
        _range(column("voltage_min_v"), column("voltage_max_v"), 2),
        _range(column("current_min_a"), column("current_max_a"), 1),
        _range(column("temperature_min_c"), column("temperature_max_c"), 0),
        f"{column('charge_out_ah').sum():.1f}",
        f"{column('charge_in_ah').sum():.1f}",
        f"{column('energy_out_wh').sum() / 1e3:.2f}",
        f"{column('energy_in_wh').sum() / 1e3:.2f}",
        f"{column('seen_s').sum() / 3600.0:.1f} h",
    )


def _range(low: Floats, high: Floats, digits: int) -> str:
    if not np.isfinite(low).any():
        return "-"
    return f"{np.nanmin(low):.{digits}f} … {np.nanmax(high):.{digits}f}"


def _learned(history: PackHistory) -> Group:
    if not history.learned:
        return Group("Learned parameters", remark=history.not_learned)
    return Group(
        "Learned parameters",
        columns=("parameter", "value", "std"),
        rows=tuple(history.learned),
        remark="From the last checkpoint of the service. Circuit elements are those of the pack at its SOC then.",
    )


def _events(events: Sequence[tuple[float, str, str]]) -> Group:
    shown = events[-MAX_EVENTS:]
    remark = f"The latest {MAX_EVENTS} of {len(events):,} events." if len(events) > MAX_EVENTS else ""
    rows = tuple((_utc(time_s), name.replace("_", " "), text) for time_s, name, text in shown)
    return Group("Events and alarms", columns=("time", "event", ""), rows=rows, is_text=True, remark=remark)


def _quality(history: PackHistory) -> Group:
    interval_s = np.diff(history.time_s)
    is_second_row = history.time_s % MINUTE_S != 0.0  # the first row of a minute has its start time
    gaps_s = interval_s[interval_s > MINUTE_S] - MINUTE_S
    rows = (
        ("minutes stored", f"{history.time_s.size:,}"),
        ("measured time", f"{100 * _measured_fraction(history):.1f} %"),
        ("gaps", f"{gaps_s.size:,}, the longest {gaps_s.max(initial=0.0) / 60.0:.0f} min"),
        ("clock", f"{np.count_nonzero(is_second_row):,} minutes passed twice, because the clock was set back"),
        ("temperature", f"in {100 * np.isfinite(history.columns['temperature_c']).mean():.0f} % of the minutes"),
    )
    return Group("Data quality", columns=("", "in this history"), rows=rows, is_text=True)


def _measured_fraction(history: PackHistory) -> float:
    duration_s = history.time_s[-1] + MINUTE_S - history.time_s[0]
    return min(float(history.columns["seen_s"].sum() / duration_s), 1.0)


def _last(values: Floats) -> float:
    """Return the last finite value, NaN without one."""
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if finite.size else float("nan")


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M")
