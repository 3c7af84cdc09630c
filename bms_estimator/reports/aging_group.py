"""Group of a report on aging: capacity and resistances over days."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from bms_estimator.pack_model.aging_course import RESISTANCE_SOC, AgingCourse, QuantityCourse
from bms_estimator.plot.style import COLORS, draw_band
from bms_estimator.reports.report_parts import DAY_S, Group, Plot, duration_text, number, small_plot

MONTH_S = 30.0 * DAY_S
"""Length of a month in "change per month" [s]."""
MIN_CHANGE_S = 7.0 * DAY_S
"""Minimum duration of a history for a change per month [s]. A change in less time is smaller than its std."""
MILLIOHM_PER_OHM = 1e3


@dataclass(frozen=True)
class AgingHistory:
    """Capacity and resistances of a pack over its fitted history.

    Attributes:
        course: Values by day; None if there is no fit.
        missing: Sentence with the reason why there is no fit; empty if there is one.
    """

    course: AgingCourse | None
    missing: str = ""


def aging_group(aging: AgingHistory) -> Group:
    """Return figures and table of capacity and resistances over days, or the reason why they are missing."""
    title = "Capacity and resistances over days"
    course = aging.course
    if course is None:
        return Group(title, remark=aging.missing)
    duration_s = course.end_s - float(course.capacity.elapsed_s[0])
    sentences = [
        f"Slow fit to the last {duration_text(duration_s)} of measurements.",
        f"Resistances are those at SOC {100 * RESISTANCE_SOC[0]:.0f} % and 25 °C; the DC resistance includes all RC pairs.",
    ]
    figures: tuple[Plot, ...] = ()
    if course.capacity.value.size > 1:
        figures = tuple(
            Plot(name, small_plot(partial(_draw, course.end_s, *part), salt=f"aging-{name}"))
            for name, part in (
                ("Capacity with ±2 std", (course.capacity, 1.0, "capacity [Ah]", COLORS[0])),
                ("DC resistance with ±2 std", (course.total, MILLIOHM_PER_OHM, "DC resistance [mΩ]", COLORS[1])),
            )
        )
        sentences.append(
            "The fit assumes that resistances change steadily with use and time. Most of the std is an error that is equal "
            "on all days; a change is therefore known better than a value."
        )
    else:
        sentences.append("Figures need more than a day of history.")
    if duration_s < MIN_CHANGE_S:
        sentences.append(f"A change per month needs at least {MIN_CHANGE_S / DAY_S:.0f} days of history.")
    return Group(title, figures, ("", "now ± std", "change per month ± std"), _rows(course), remark=" ".join(sentences))


def _rows(course: AgingCourse) -> tuple[tuple[str, ...], ...]:
    quantities = (
        ("capacity [Ah]", course.capacity, 1.0),
        ("R_s [mΩ]", course.series, MILLIOHM_PER_OHM),
        ("DC resistance [mΩ]", course.total, MILLIOHM_PER_OHM),
    )
    return tuple(
        (
            name,
            f"{number(scale * each.value[-1])} ± {number(scale * each.std[-1], 2)}",
            _change_per_month(each, course.end_s),
        )
        for name, each, scale in quantities
    )


def _change_per_month(course: QuantityCourse, end_s: float) -> str:
    """Return the relative change per month with its std."""
    if end_s - course.elapsed_s[0] < MIN_CHANGE_S or course.value.size == 1:
        return "-"
    months = float(course.elapsed_s[-1] - course.elapsed_s[0]) / MONTH_S
    change, std = course.relative_change()
    return f"{100.0 * change / months:+.1f} ± {100.0 * std / months:.1f} %"


def _draw(end_s: float, course: QuantityCourse, scale: float, label: str, color: str, ax: Any) -> None:
    days = (course.elapsed_s - end_s) / DAY_S
    value, std = scale * course.value, scale * course.std
    draw_band(ax, days, value - 2.0 * std, value + 2.0 * std, color=color)
    ax.plot(days, value, color=color)
    ax.set(xlabel="time before the last row [days]", ylabel=label)
    ax.margins(x=0.01)
