"""Methods side by side on real captures: what each learns from one profile, tried on others that it never saw.

``make compare``, or some of the trials: ``make compare ARGS="NCR PF"``; with ``--json`` the figures one by one. What is
measured and how is in docs/comparison.md.
"""

import json
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.stats import rankdata

from tests.benchmarks.recipes import DATA, cell_file
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
    Bench,
    Figure,
    Reference,
    of_trial,
    step_costs,
)
from tests.benchmarks.side_by_side.methods import FILE, METHODS
from tests.benchmarks.side_by_side.trials import TRIALS, chosen

Floats = NDArray[np.float64]

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
FACTORS = (R_S, TAU_TS, TAU_TL)
TIMED = (TRIALS[0], TRIALS[2])
"""At 1 and at 10 Hz."""


def main() -> None:
    """Print the tables."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    trials = chosen([word for word in sys.argv[1:] if not word.startswith("--")])
    figures: list[Figure] = []
    references: list[Reference] = []
    with tempfile.TemporaryDirectory() as folder:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(cell_file, {trial.recipe for trial in trials}, repeat(Path(folder))))
        with ProcessPoolExecutor() as pool:
            for reference, found in pool.map(of_trial, trials, repeat(Path(folder))):
                references.append(reference)
                figures += found
        for trial in TIMED:
            bench = Bench(trial, Path(folder))
            figures += step_costs(bench.starts[0][1], bench.first.samples, trial.name)
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps([asdict(figure) for figure in figures]) + "\n")
        return
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(reference_table(references))
    for name, (title, digits) in TABLES.items():
        console.print(figure_table([f for f in figures if f.table == name], title, digits, name in FACTORS))


def reference_table(references: list[Reference]) -> Table:
    """What the methods are judged by: median, and what half of the values lie between."""
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


def figure_table(figures: list[Figure], title: str, digits: int, factor: bool) -> Table:
    """Rows as they came, a column for each method, the mean of both starts; then the geometric mean and the mean rank.

    A factor's mean is geometric. "none": it said nothing usable from one start at least; "never" is infinite.
    """
    shown = [m.name for m in (*METHODS, FILE) if any(f.method == m.name for f in figures)]
    table = Table("", *shown, title=escape(title), box=box.MARKDOWN)
    rows = list(dict.fromkeys(f.row for f in figures))
    values = np.full((len(rows), len(shown)), -np.inf)
    for i, row in enumerate(rows):
        for j, method in enumerate(shown):
            both = np.array([f.value for f in figures if (f.row, f.method) == (row, method)])
            if both.size:
                values[i, j] = np.exp(np.mean(np.log(both))) if factor else both.mean()
        table.add_row(row, *(text(x, digits) for x in values[i]))
    usable = np.isfinite(values).all(axis=1)
    if usable.any():
        means = np.exp(np.log(np.maximum(values[usable], 1e-3)).mean(axis=0))
        table.add_row(f"geometric mean of {usable.sum()}", *(text(x, digits) for x in means))
    compete = [j for j, name in enumerate(shown) if name != FILE.name]
    took_part = np.where(np.isneginf(values), np.nan, np.nan_to_num(values, nan=np.inf, posinf=np.inf))[:, compete]
    ranks = rankdata(took_part.round(digits), axis=1, nan_policy="omit")
    table.add_row("mean rank", *(text(x, 1) for x in np.nanmean(ranks, axis=0)))
    return table


def text(value: float, digits: int) -> str:
    """A number; nothing, none and never where it is none."""
    if np.isneginf(value):
        return "-"
    if np.isnan(value):
        return "none"
    return "never" if np.isinf(value) else f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
