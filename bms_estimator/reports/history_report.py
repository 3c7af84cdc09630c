"""Report on a pack's stored history, with a table of totals and extremes by day."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.plot.style import (
    COLORS,
    FAINT,
    MAX_POINTS,
    MIN_CURRENT_SPAN_A,
    MIN_SOC_SPAN_PERCENT,
    MIN_TEMPERATURE_SPAN_K,
    MIN_VOLTAGE_SPAN_V,
    draw_band,
    thin,
    widen,
)
from bms_estimator.reports.aging_group import AgingHistory, aging_group
from bms_estimator.reports.report_parts import (
    DAY_S,
    MINUTE_S,
    Group,
    Plot,
    ReportPage,
    Section,
    duration_text,
    number,
    small_plot,
)

MAX_DAYS = 62
"""Maximum number of days in the table. Older days are only in the figures."""
WH_PER_KWH = 1000.0
"""Watt-hours in a kilowatt-hour. The table is in kWh if a day has at least one."""
MIN_FOR_ONE_DECIMAL = 1.0
"""A column whose largest value is at least this has one decimal, otherwise three [A, Ah, Wh or kWh]."""
CHARGES, ENERGIES = ("charge_out_ah", "charge_in_ah"), ("energy_out_wh", "energy_in_wh")
"""Columns that are summed."""

ColumnsByName = Mapping[str, Floats]


def day_table(history: ColumnsByName) -> Group:
    """Return the table of the last days.

    Args:
        history: Columns of ``store.history.Minute`` by name, each of shape (n,); NaN where a value is missing.
    """
    day_of = np.floor(history["time_s"] / DAY_S).astype(np.int64)
    days = [{name: values[day_of == day] for name, values in history.items()} for day in np.unique(day_of)[-MAX_DAYS:]]
    charges_ah, energies_wh = _sums(days, CHARGES), _sums(days, ENERGIES)
    unit, unit_wh = ("kWh", WH_PER_KWH) if energies_wh.max() >= WH_PER_KWH else ("Wh", 1.0)
    largest_a = np.abs([history["current_min_a"], history["current_max_a"]]).max()
    rows = (
        (*_date_and_ranges(day, _decimals(largest_a)), *charges, *energies, duration_text(day["seen_s"].sum()))
        for day, charges, energies in zip(days, _texts(charges_ah), _texts(energies_wh / unit_wh), strict=True)
    )
    return Group(
        "Days",
        columns=("day (UTC)", "SOC [%]", "V", "A", "°C", "Ah out", "Ah in", f"{unit} out", f"{unit} in", "measured"),
        rows=tuple(rows),
        remark="Ranges are minimum and maximum. Positive current discharges the pack.",
    )


def _sums(days: Sequence[ColumnsByName], names: Sequence[str]) -> Floats:
    """Return the sum of each column over each day, shape (days, columns)."""
    return np.array([[day[name].sum() for name in names] for day in days])


def _texts(values: Floats) -> list[list[str]]:
    digits = _decimals(float(values.max()))
    return [[f"{value:.{digits}f}" for value in row] for row in values]


def _decimals(largest: float) -> int:
    """Return the number of decimals of a column by its largest value."""
    return 1 if largest >= MIN_FOR_ONE_DECIMAL else 3


def _date_and_ranges(day: ColumnsByName, current_digits: int) -> tuple[str, ...]:
    """Return the date, and the ranges of SOC, voltage, current and temperature."""
    return (
        datetime.fromtimestamp(day["time_s"][0], UTC).strftime("%Y-%m-%d"),
        _range(100.0 * day["soc"], 100.0 * day["soc"], 0),
        _range(day["voltage_min_v"], day["voltage_max_v"], 2),
        _range(day["current_min_a"], day["current_max_a"], current_digits),
        _range(day["temperature_min_c"], day["temperature_max_c"], 0),
    )


def _range(low: Floats, high: Floats, digits: int) -> str:
    if not np.isfinite(low).any():
        return "-"
    return f"{np.nanmin(low):.{digits}f} … {np.nanmax(high):.{digits}f}"


GAP_S = 15 * 60.0
"""Interval between two rows above which no line connects them [s]. Shorter gaps are not visible over a day."""
MIN_POINTS = 30
"""Minimum number of points of a line between two gaps."""
MAX_MARKED_ROWS = 30
"""Maximum number of rows at which each row has a marker. A row between two gaps has no line, and would be invisible."""
MIN_ROWS = 2
"""Minimum number of rows with a value for a figure."""
MIN_TICKS = 3
"""Minimum number of labels on the time axis. With more, matplotlib finds no interval for 3 to 5 hours, and for 3 to 5 days."""
MAX_TICKS = 7
"""Maximum number of labels on the time axis. More would overlap."""
TICK_MINUTES = [1, 2, 5, 10, 15, 30]
"""Possible intervals of the labels within an hour [min]. Without 2, a history of 8 minutes would have one label."""
MAX_EVENTS = 100
"""Maximum number of events in the table; the latest ones are shown."""


@dataclass(frozen=True)
class StoredHistory:
    """Stored history of a pack.

    Attributes:
        pack: Name of the pack.
        time_s: Shape (n,), start of each minute [s since 1970], increasing. A minute that passed twice, because the clock was
            set back, has a second row some seconds later.
        columns: Columns of ``store.history.Minute`` by name, each of shape (n,); NaN where a value is missing.
        events: Time [s since 1970], name and text of each event, oldest first.
        learned: Name, value and std of each learned parameter in the last checkpoint; empty without a checkpoint.
        not_learned: Reason why there are no learned parameters; empty if there are some.
        aging: Capacity and resistances over the days of the fitted history.
        warnings: Doubts about the history, one text each.
    """

    pack: str
    time_s: Floats
    columns: Mapping[str, Floats]
    events: Sequence[tuple[float, str, str]]
    learned: Sequence[tuple[str, str, str]]
    not_learned: str
    aging: AgingHistory
    warnings: Sequence[str] = ()


def history_report(history: StoredHistory, written: str) -> ReportPage:
    """Return the report on a pack's history, which has at least one row."""
    begin, end = _utc(history.time_s[0]), _utc(history.time_s[-1])
    events = [_events(history.events)] if history.events else []
    groups = [
        _over_time(history),
        day_table(history.columns),
        aging_group(history.aging),
        _learned(history),
        *events,
        _quality(history),
    ]
    return ReportPage(
        title=f"{history.pack}: report on its history",
        subtitle=f"{begin} to {end}",
        grade="",
        sentences=tuple(_sentences(history)),
        sections=(Section("History", sentences=(), warnings=tuple(history.warnings), groups=tuple(groups)),),
        written=written,
    )


def _sentences(history: StoredHistory) -> list[str]:
    """Return sentences on the SOC, the charge and the measured time of the pack."""
    columns = history.columns
    out_ah, in_ah = float(columns["charge_out_ah"].sum()), float(columns["charge_in_ah"].sum())
    duration = duration_text(history.time_s[-1] + MINUTE_S - history.time_s[0])
    sentences = []
    soc, std = _last(columns["soc"]), _last(columns["soc_std"])
    if np.isfinite(soc):
        band = f" ± {200 * std:.1f} % (2 std)" if np.isfinite(std) else ""
        sentences.append(f"The pack's SOC at the end is {100 * soc:.1f} %{band}.")
        sentences.append(
            f"In {duration} it ran between SOC {100 * np.nanmin(columns['soc']):.0f} % and "
            f"{100 * np.nanmax(columns['soc']):.0f} %."
        )
    sentences.append(f"{number(out_ah, 3)} Ah were drawn and {number(in_ah, 3)} Ah charged.")
    sentences.append(f"{100 * _measured_fraction(history):.1f} % of the time was measured.")
    return sentences


def _over_time(history: StoredHistory) -> Group:
    """Return the figures over time. A sentence replaces a figure without values."""
    figures, sentences = [], []
    for title, column, needed, draw in _FIGURES:
        rows = np.count_nonzero(np.isfinite(history.columns[column]))
        if rows >= MIN_ROWS:
            figures.append(Plot(title, small_plot(partial(draw, history), salt=f"history-{title}")))
        elif history.time_s.size >= MIN_ROWS:
            sentences.append(f"{title}: no figure, because {needed}.")
    if figures:
        sentences.append("Bands of voltage, current and temperature are the extremes of each minute.")
    else:
        sentences.insert(
            0, "No figures: they need two minutes of history. The service stores each minute when it ends."
        )
    return Group("Over time", tuple(figures), remark=" ".join(sentences))


def _draw_soc(history: StoredHistory, ax: Any) -> None:
    soc, std = 100.0 * history.columns["soc"], 200.0 * np.nan_to_num(history.columns["soc_std"])
    time, middle, low, high = _with_gaps(history.time_s, soc, (soc - std).clip(0.0), (soc + std).clip(max=100.0))
    draw_band(ax, time, low, high)
    ax.plot(time, middle, color=COLORS[0], marker=_marker(history))
    _label_axes(ax, "SOC [%]", MIN_SOC_SPAN_PERCENT)


def _draw_range(
    quantity: str, unit: str, label: str, min_span: float, color: str
) -> Callable[[StoredHistory, Any], None]:
    """Return a function that draws the mean of a quantity with the band of its extremes, on an axis of at least ``min_span``."""

    def draw(history: StoredHistory, ax: Any) -> None:
        mean, low, high = (history.columns[f"{quantity}_{part}{unit}"] for part in ("", "min_", "max_"))
        time, mean, low, high = _with_gaps(history.time_s, mean, low, high)
        draw_band(ax, time, low, high, color=color)
        ax.plot(time, mean, color=color, linewidth=0.9, marker=_marker(history))
        if quantity == "current":
            ax.axhline(0.0, color=FAINT, linewidth=0.8)
        _label_axes(ax, label, min_span)

    return draw


def _marker(history: StoredHistory) -> str:
    return "." if history.time_s.size <= MAX_MARKED_ROWS else ""


_FIGURES = (
    (
        "SOC with ±2 std",
        "soc",
        "the estimator has published no SOC; it needs a measured voltage and current",
        _draw_soc,
    ),
    (
        "Voltage",
        "voltage_v",
        "no voltage was measured",
        _draw_range("voltage", "v", "voltage [V]", MIN_VOLTAGE_SPAN_V, COLORS[0]),
    ),
    (
        "Current",
        "current_a",
        "no current was measured",
        _draw_range("current", "a", "current [A], discharge > 0", MIN_CURRENT_SPAN_A, COLORS[2]),
    ),
    (
        "Temperature",
        "temperature_c",
        "it was not measured; it needs a source with a temperature sensor",
        _draw_range("temperature", "c", "temperature [°C]", MIN_TEMPERATURE_SPAN_K, COLORS[3]),
    ),
)
"""Title of each figure, column that must have values, reason for a missing figure, and function that draws the figure."""


def _with_gaps(time_s: Floats, *curves: Floats) -> tuple[Floats, ...]:
    """Return thinned curves over the time [days since 1970], with NaN in each gap, so that no line crosses it."""
    ends = np.flatnonzero(np.diff(time_s) > GAP_S) + 1
    bounds = [0, *ends.tolist(), time_s.size]
    points = max(MAX_POINTS // len(bounds), MIN_POINTS)
    parts = []
    for first, last in itertools.pairwise(bounds):
        thinned = thin(time_s[first:last], *(curve[first:last] for curve in curves), points=points)
        parts.append([np.append(column, np.nan) for column in thinned])
    joined_s, *joined = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return (joined_s / DAY_S, *joined)


def _label_axes(ax: Any, label: str, min_span: float) -> None:
    """Label the axes of a plot over days since 1970 with dates and times.

    Args:
        ax: The axes.
        label: Label of the vertical axis.
        min_span: Minimum span of the vertical axis.
    """
    from matplotlib import dates as matplotlib_dates  # noqa: PLC0415 - optional

    dates: Any = matplotlib_dates  # its functions have no types
    locator = dates.AutoDateLocator(minticks=MIN_TICKS, maxticks=MAX_TICKS)
    locator.intervald[dates.MINUTELY] = TICK_MINUTES
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    ax.set(xlabel="time (UTC)", ylabel=label)
    ax.margins(x=0.01)
    widen(ax, min_span)


def _learned(history: StoredHistory) -> Group:
    if not history.learned:
        return Group("Learned parameters", remark=history.not_learned)
    return Group(
        "Learned parameters",
        columns=("parameter", "value", "std"),
        rows=tuple(history.learned),
        remark="From the last checkpoint of the service. Circuit elements are values at the SOC of that time.",
    )


def _events(events: Sequence[tuple[float, str, str]]) -> Group:
    shown = events[-MAX_EVENTS:]
    remark = f"The latest {MAX_EVENTS} of {len(events):,} events." if len(events) > MAX_EVENTS else ""
    rows = tuple((_utc(time_s), name.replace("_", " "), text) for time_s, name, text in shown)
    return Group("Events and alarms", columns=("time", "event", "details"), rows=rows, is_text=True, remark=remark)


def _quality(history: StoredHistory) -> Group:
    interval_s = np.diff(history.time_s)
    is_second_row = history.time_s % MINUTE_S != 0.0  # the first row of a minute has its start time
    gaps_s = interval_s[interval_s > MINUTE_S] - MINUTE_S
    repeated = np.count_nonzero(is_second_row)
    rows = (
        ("minutes stored", f"{history.time_s.size:,}"),
        ("measured time", f"{100 * _measured_fraction(history):.1f} %"),
        ("gaps", f"{gaps_s.size:,}, the longest {duration_text(gaps_s.max())}" if gaps_s.size else "none"),
        ("clock", f"set back; minutes that passed twice: {repeated:,}" if repeated else "not set back"),
        ("temperature", f"in {100 * np.isfinite(history.columns['temperature_c']).mean():.0f} % of the minutes"),
    )
    return Group("Data quality", columns=("", "in this history"), rows=rows, is_text=True)


def _measured_fraction(history: StoredHistory) -> float:
    duration_s = history.time_s[-1] + MINUTE_S - history.time_s[0]
    return min(float(history.columns["seen_s"].sum() / duration_s), 1.0)


def _last(values: Floats) -> float:
    """Return the last finite value, NaN without one."""
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if finite.size else float("nan")


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M")
