"""The tables, in Markdown."""

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
PYBOP = "PyBOP"
FACTORS = (R_S, TAU_TS, TAU_TL)
NOTHING = -np.inf
"""A method does not do that, or nothing shows it."""


def reference_table(references: list[Reference]) -> Table:
    """Return the references: median, and the interquartile range."""
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
    """Median and both quartiles, or a dash."""
    if not values.size:
        return "-"
    low, middle, high = (f"{x:.{digits}f}" for x in np.percentile(values, (25, 50, 75)))
    return f"{middle} ({low}-{high})"


def figure_tables(figures: Iterable[Figure]) -> Iterator[Table]:
    """All of them that there are figures for."""
    for name, (title, digits) in TABLES.items():
        of_it = [f for f in figures if f.table == name]
        if of_it:
            yield figure_table(name, of_it, title, digits)


def figure_table(name: str, figures: list[Figure], title: str, digits: int) -> Table:
    """Return the rows with a column for each method: the mean of both starts, of steps both; then the mean over
    rows.

    That is geometric, of the rows with a number, how many in brackets where they are not all; and the mean rank.
    """
    shown = [m.name for m in (*METHODS, FILE) if any(f.method == m.name for f in figures)]
    table = Table("", *shown, title=escape(title), box=box.MARKDOWN)
    rows = list(dict.fromkeys(f.row for f in figures))
    values = np.full((len(rows), len(shown)), NOTHING)
    for i, row in enumerate(rows):
        both = [[f.value for f in figures if (f.row, f.method) == (row, method)] for method in shown]
        values[i] = [mean(np.array(x), name in FACTORS) for x in both]
        each = both if name == JUMP else [[x] for x in values[i]]
        table.add_row(row, *(" / ".join(text(x, digits, name) for x in some) or "-" for some in each))
    if name != JUMP:
        table.add_row("geometric mean", *(over_rows(column, digits) for column in values.T))
        common = np.isfinite(values[:, [j for j, method in enumerate(shown) if method == PYBOP]]).all(axis=1)
        if PYBOP in shown and not common.all():
            means = (over_rows(column, digits) for column in values[common].T)
            table.add_row(f"geometric mean, the {common.sum()} rows of PyBOP", *means)
    compete = [j for j, method in enumerate(shown) if method != FILE.name]
    took_part = np.where(values == NOTHING, np.nan, np.nan_to_num(values, nan=np.inf, posinf=np.inf))[:, compete]
    ranks = rankdata(took_part.round(digits), axis=1, nan_policy="omit")
    table.add_row("mean rank", *(f"{x:.1f}" for x in np.nanmean(ranks, axis=0)))
    return table


def seed_table(figures: Iterable[Figure]) -> Table:
    """Spread of PyBOP's voltage over its seeds: lowest, median and highest mean over both starts, for each row."""
    table = Table(
        "",
        "seeds",
        "lowest",
        "median",
        "highest",
        title=escape("PyBOP: voltage RMS over its seeds [mV]"),
        box=box.MARKDOWN,
    )
    of_it = [f for f in figures if (f.table, f.method) == (VOLTAGE, PYBOP)]
    for row in dict.fromkeys(f.row for f in of_it):
        seeds = sorted({f.seed for f in of_it if f.row == row})
        means = [np.mean([f.value for f in of_it if (f.row, f.seed) == (row, seed)]) for seed in seeds]
        table.add_row(row, f"{len(seeds)}", *(f"{x:.1f}" for x in np.percentile(means, (0, 50, 100))))
    return table


def mean(values: Floats, factor: bool) -> float:
    """Return the mean of both starts; the geometric one for factors."""
    if not values.size:
        return NOTHING
    return float(np.exp(np.mean(np.log(values)))) if factor else float(values.mean())


def over_rows(column: Floats, digits: int) -> str:
    """Geometric mean of what are numbers."""
    numbers = column[np.isfinite(column)]
    if not numbers.size:
        return "-"
    counted = "" if numbers.size == column.size else f" ({numbers.size})"
    return f"{np.exp(np.mean(np.log(np.maximum(numbers, 10.0**-digits)))):.{digits}f}{counted}"


def text(value: float, digits: int, name: str) -> str:
    """Format a number, or the reason why there is none."""
    if value == NOTHING:
        return "-"
    if np.isinf(value) and name == JUMP:
        return "never"
    return f"{value:.{digits}f}" if np.isfinite(value) else "none"
