"""Results of the estimator for each case: a small table under version control, so that a change shows as a diff."""

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.records import LN_Q
from tests.estimator.anywhere.cases import CASES, WRONG, Capture, Case, capture
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import Score, score

PATH = Path(__file__).with_name("summary.csv")
DIGITS = 2


@dataclass(frozen=True)
class Row:
    """Result of one case with the initial SOC error ``wrong``."""

    case: str
    wrong: float
    score: Score
    nis: float
    """``Run.nis``."""
    capacity: float
    """Learned over true capacity, less 1 [%]."""
    reopened: int
    """Number of re-initializations of the SOC."""


def rows(cases: Iterable[Case] = CASES) -> list[Row]:
    """Return the results of every case and start."""
    return [row(case, seen, wrong) for case in cases for seen in [capture(case)] for wrong in WRONG]


def row(case: Case, seen: Capture, wrong: float) -> Row:
    """Return the result of one run."""
    estimator = Estimator(seen.cell, initial_soc=float(np.clip(seen.soc[0] + wrong, 0.0, 1.0)))
    run = run_of(estimator, seen.samples)
    result = score(seen.samples["time_s"], run.soc, run.soc_std, seen.soc, case.after_s)
    assert result is not None
    f = estimator.record[0]["filter"]
    capacity = case.capacity * np.exp(f["mean"][f["best"], LN_Q])
    return Row(case.name, wrong, result, run.nis(case.after_s), 100.0 * (capacity - 1.0), int(f["reopened"]))


HEAD = ("case", "wrong", *(f.name for f in fields(Score)), "nis", "capacity", "reopened")


def numbers(r: Row) -> tuple[float, ...]:
    """Return the numbers in the order of ``HEAD``, from the third on."""
    return (*astuple(r.score), r.nis, r.capacity, float(r.reopened))


def write(table: list[Row]) -> None:
    """Write the checked-in table."""
    with PATH.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEAD)
        for r in table:
            writer.writerow([r.case, f"{r.wrong:+.1f}", *(f"{v:.{DIGITS}f}" for v in numbers(r))])


def read() -> dict[tuple[str, float], tuple[float, ...]]:
    """Return the checked-in ``numbers`` by case and start."""
    with PATH.open() as file:
        lines = list(csv.reader(file))[1:]
    return {(line[0], float(line[1])): tuple(map(float, line[2:])) for line in lines}
