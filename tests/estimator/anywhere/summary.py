"""Table of the estimator's results for each case. It is under version control, so that a change shows as a diff."""

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.records import LN_Q
from tests.estimator.anywhere.cases import CASES, SOC_ERRORS, Capture, Case, capture
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import Score, score

SUMMARY_PATH = Path(__file__).with_name("summary.csv")
DIGITS = 2
"""Decimal digits of the table."""


@dataclass(frozen=True)
class Row:
    """Result of one case with one error of the initial SOC."""

    case: str
    """Name of the case."""
    soc_error: float
    score: Score
    nis: float
    """Normalized innovation squared, see ``Run.nis``."""
    capacity_error_percent: float
    """Relative error of the learned capacity [%]."""
    reinitializations: int
    """Number of re-initializations of the SOC."""


def rows(cases: Iterable[Case] = CASES) -> list[Row]:
    """Return the results of every case, each with every error of the initial SOC."""
    return [
        row(case, recording, soc_error)
        for case, recording in ((case, capture(case)) for case in cases)
        for soc_error in SOC_ERRORS
    ]


def row(case: Case, recording: Capture, soc_error: float) -> Row:
    """Run the estimator over the capture of a case."""
    estimator = Estimator(recording.cell, initial_soc=float(np.clip(recording.soc[0] + soc_error, 0.0, 1.0)))
    run = run_of(estimator, recording.samples)
    result = score(recording.samples["time_s"], run.soc, run.soc_std, recording.soc, case.after_s)
    assert result is not None
    f = estimator.record[0]["filter"]
    # LN_Q is the ln of (learned capacity / capacity in the file); ``file_capacity_ratio`` is (capacity in the file / true capacity)
    learned_over_true = case.file_capacity_ratio * np.exp(f["mean"][f["best"], LN_Q])
    capacity_error = 100.0 * (learned_over_true - 1.0)
    return Row(case.name, soc_error, result, run.nis(case.after_s), capacity_error, int(f["reopened"]))


SUMMARY_COLUMNS = ("case", "soc_error", *(f.name for f in fields(Score)), "nis", "capacity", "reopened")


def numbers(r: Row) -> tuple[float, ...]:
    """Return the values of the summary columns that follow the name of the case and the SOC error."""
    return (*astuple(r.score), r.nis, r.capacity_error_percent, float(r.reinitializations))


def write(table: list[Row]) -> None:
    """Write the checked-in table."""
    with SUMMARY_PATH.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(SUMMARY_COLUMNS)
        for r in table:
            writer.writerow([r.case, f"{r.soc_error:+.1f}", *(f"{v:.{DIGITS}f}" for v in numbers(r))])


def read() -> dict[tuple[str, float], tuple[float, ...]]:
    """Return the checked-in ``numbers`` by name of the case and error of the initial SOC."""
    with SUMMARY_PATH.open() as file:
        lines = list(csv.reader(file))[1:]
    return {(line[0], float(line[1])): tuple(map(float, line[2:])) for line in lines}
