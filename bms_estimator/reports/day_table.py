"""Table of a pack's totals and extremes by day."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.reports.formats import DAY_S, duration_text
from bms_estimator.reports.report_page import Group

MAX_DAYS = 62
"""Maximum number of days in the table. Older days are only in the figures."""
WH_PER_KWH = 1000.0
"""Watt-hours in a kilowatt-hour. The table is in kWh if a day has at least one."""
MIN_FOR_ONE_DECIMAL = 1.0
"""Largest value from which a column has one decimal, otherwise three [A, Ah, Wh or kWh]."""
CHARGES, ENERGIES = ("charge_out_ah", "charge_in_ah"), ("energy_out_wh", "energy_in_wh")
"""Columns that are summed."""

ColumnsByName = Mapping[str, Floats]


def day_table(history: ColumnsByName) -> Group:
    """Return the table of the last days.

    Args:
        history: Columns of ``store.minute.Minute`` by name, each of shape (n,); NaN where a value is missing.
    """
    number = np.floor(history["time_s"] / DAY_S).astype(np.int64)
    days = [{name: values[number == day] for name, values in history.items()} for day in np.unique(number)[-MAX_DAYS:]]
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
