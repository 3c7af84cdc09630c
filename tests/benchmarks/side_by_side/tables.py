"""Tables of the comparison, in Markdown."""

from collections.abc import Iterable, Iterator

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table
from scipy.stats import rankdata

from bms_estimator.model.arrays import Floats
from tests.benchmarks.side_by_side.measure import (
    FIT,
    JUMP,
    R_S,
    SOC,
    STEP,
    TAU_TL,
    TAU_TS,
    VOLTAGE,
    VOLTAGE_WRONG,
    Figure,
    Reference,
)
from tests.benchmarks.side_by_side.methods import FILE, METHODS

TABLES = {
    VOLTAGE: ("voltage RMS of the capture held back, open loop [mV]", 1),
    R_S: ("R_s over that of pulses, typical factor off", 2),
    TAU_TS: ("shorter RC product over that of rests, typical factor off", 2),
    TAU_TL: ("longer RC product over that of rests, typical factor off", 2),
    SOC: ("SOC RMSE, entered in mid-load 0.2 too low [%]", 1),
    VOLTAGE_WRONG: ("voltage RMS as above, SOC 0.1 too low while it learned [mV]", 1),
    JUMP: ("R_s grows by half: minutes until it is within 10 %", 1),
    STEP: ("a step [ns]", 0),
    FIT: ("a fit, processor time [s]", 1),
}
"""Title and number of digits of each table."""
PYBOP = "PyBOP"
FACTOR_TABLES = (R_S, TAU_TS, TAU_TL)
"""Tables whose values are factors, so that their mean is geometric."""
NO_VALUE = -np.inf
"""Mark of a method that does not offer the quantity, or of a capture that does not show it."""


def reference_table(references: list[Reference]) -> Table:
    """Return the table of the references: median and quartiles of each."""
    table = Table(title="references: median (quartiles)", box=box.MARKDOWN)
    for column in ("trial", "pulses", "R_s [mOhm]", "rests", "shorter RC product [s]", "longer [s]"):
        table.add_column(escape(column), justify="left" if column == "trial" else "right")
    for r in references:
        pulses, rests = r.pulses, r.rests
        table.add_row(
            r.trial,
            f"{pulses.ohm.size}",
            quartiles(1e3 * pulses.ohm, 1),
            f"{rests.soc.size}",
            quartiles(rests.tau_ts_s, 0),
            quartiles(rests.tau_tl_s, 0),
        )
    return table


def quartiles(values: Floats, digits: int) -> str:
    """Return median and both quartiles as text; a dash without values."""
    if not values.size:
        return "-"
    low, middle, high = (f"{x:.{digits}f}" for x in np.percentile(values, (25, 50, 75)))
    return f"{middle} ({low}-{high})"


def figure_tables(figures: Iterable[Figure]) -> Iterator[Table]:
    """Yield each table for which there are figures."""
    for name, (title, digits) in TABLES.items():
        figures_of_table = [f for f in figures if f.table == name]
        if figures_of_table:
            yield figure_table(name, figures_of_table, title, digits)


def figure_table(name: str, figures: list[Figure], title: str, digits: int) -> Table:
    """Return a table with a column for each method.

    A cell has the mean of both starts, or both values in the table of the step of R_s. The last rows have the geometric mean
    over the rows with a number (the count of these rows is in brackets if it is not the count of all), and the mean rank.
    """
    methods = [m.name for m in (*METHODS, FILE) if any(f.method == m.name for f in figures)]
    table = Table("", *methods, title=escape(title), box=box.MARKDOWN)
    rows = list(dict.fromkeys(f.row for f in figures))
    values = np.full((len(rows), len(methods)), NO_VALUE)
    for i, row in enumerate(rows):
        by_start = [[f.value for f in figures if (f.row, f.method) == (row, method)] for method in methods]
        values[i] = [mean(np.array(x), geometric=name in FACTOR_TABLES) for x in by_start]
        cells = by_start if name == JUMP else [[x] for x in values[i]]
        table.add_row(row, *(" / ".join(format_value(x, digits, name) for x in cell) or "-" for cell in cells))
    if name != JUMP:
        table.add_row("geometric mean", *(mean_over_rows(column, digits) for column in values.T))
        has_pybop = np.isfinite(values[:, [j for j, method in enumerate(methods) if method == PYBOP]]).all(axis=1)
        if PYBOP in methods and not has_pybop.all():
            means = (mean_over_rows(column, digits) for column in values[has_pybop].T)
            table.add_row(f"geometric mean, the {has_pybop.sum()} rows of PyBOP", *means)
    # The cell file has no rank. A failed method (NaN) ranks last. A method without a value has no rank in this row.
    ranked_methods = [j for j, method in enumerate(methods) if method != FILE.name]
    finite_or_last = np.nan_to_num(values, nan=np.inf, posinf=np.inf)
    ranked_values = np.where(values == NO_VALUE, np.nan, finite_or_last)[:, ranked_methods]
    ranks = rankdata(ranked_values.round(digits), axis=1, nan_policy="omit")
    table.add_row("mean rank", *(f"{x:.1f}" for x in np.nanmean(ranks, axis=0)))
    return table


def seed_table(figures: Iterable[Figure]) -> Table:
    """Return the spread of PyBOP's voltage error over its seeds: for each row, quantiles of the mean of both starts."""
    table = Table(
        "",
        "seeds",
        "lowest",
        "median",
        "highest",
        title=escape("PyBOP: voltage RMS over its seeds [mV]"),
        box=box.MARKDOWN,
    )
    of_pybop = [f for f in figures if (f.table, f.method) == (VOLTAGE, PYBOP)]
    for row in dict.fromkeys(f.row for f in of_pybop):
        seeds = sorted({f.seed for f in of_pybop if f.row == row})
        means = [np.mean([f.value for f in of_pybop if (f.row, f.seed) == (row, seed)]) for seed in seeds]
        table.add_row(row, f"{len(seeds)}", *(f"{x:.1f}" for x in np.percentile(means, (0, 50, 100))))
    return table


def mean(values: Floats, *, geometric: bool) -> float:
    """Return the mean; ``NO_VALUE`` without values."""
    if not values.size:
        return NO_VALUE
    return float(np.exp(np.mean(np.log(values)))) if geometric else float(values.mean())


def mean_over_rows(column: Floats, digits: int) -> str:
    """Return the geometric mean of the finite values of a column, with their count if some are missing."""
    numbers = column[np.isfinite(column)]
    if not numbers.size:
        return "-"
    count = "" if numbers.size == column.size else f" ({numbers.size})"
    at_least_last_digit = np.maximum(numbers, 10.0**-digits)  # a zero has no logarithm
    return f"{np.exp(np.mean(np.log(at_least_last_digit))):.{digits}f}{count}"


def format_value(value: float, digits: int, name: str) -> str:
    """Format a value, or the reason for a missing value."""
    if value == NO_VALUE:
        return "-"
    if np.isinf(value) and name == JUMP:
        return "never"
    return f"{value:.{digits}f}" if np.isfinite(value) else "none"
