"""Benchmark of kills, restarts and gaps on real captures: RMSE of the SOC / fraction inside 2 soc_std / interval score [%].

The estimator starts in mid-load with an SOC 0.2 too low and 0.2 too high. Results are scored from 15 min later on, above SOC
0.05, as in `make anywhere`.
"""

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from tests.benchmarks.recipes import GROUPS, chosen, runs
from tests.estimator.anywhere.score import score

DEFAULT_GROUPS = ("PF 25 C, US06", "PF 0 C", "NCR", "NCR, constant current", "LFP 25 C (its own file)")
SEED = 1


@dataclass(frozen=True)
class Disturbance:
    """Disturbance that recurs. Its interval and its duration vary at random by up to a third."""

    name: str
    every_s: float
    """Interval between two disturbances [s]."""
    missing_s: float
    """Time without samples [s]."""
    max_age_s: float | None = None
    """Maximum age of the checkpoint from which the estimator resumes [s]; None: the estimator is not killed."""


DISTURBANCES = (
    Disturbance("undisturbed", np.inf, 0.0),
    Disturbance("killed every 100 s, checkpoint up to 60 s old", 100.0, 12.0, 60.0),
    Disturbance("killed every 10 min, checkpoint up to 60 s old", 600.0, 12.0, 60.0),
    Disturbance("off for half an hour every 2 h", 7200.0, 1800.0, 1.0),
    Disturbance("400 s without samples each hour", 3600.0, 400.0),
    Disturbance("30 s without samples every 5 min", 300.0, 30.0),
)


def run_with_disturbance(estimator: Estimator, samples: SampleBlock, disturbance: Disturbance) -> NDArray[np.void]:
    """Return the trace of a disturbed run."""
    random, time_s, traces, begin = np.random.default_rng(SEED), samples["time_s"], [], 0
    while begin < samples.size:
        end_s = time_s[begin] + disturbance.every_s * random.uniform(0.67, 1.33)
        missing_s, age_s = (
            disturbance.missing_s * random.uniform(0.67, 1.33),
            (disturbance.max_age_s or 0.0) * random.uniform(),
        )
        checkpoint_index, end = np.searchsorted(time_s, [end_s - age_s, end_s])
        traces.append(estimator.run(samples[begin:checkpoint_index]).copy())
        checkpoint = estimator.record.copy()
        traces.append(estimator.run(samples[checkpoint_index:end]).copy())
        if disturbance.max_age_s is not None and checkpoint["observer"]["started"][0]:
            estimator.record[...] = checkpoint
            estimator.resume(age_s + missing_s)
        begin = int(np.searchsorted(time_s, end_s + missing_s))
    return np.concatenate(traces)


def table_cell(runs_of_group: Iterable[tuple[CellModel, SampleBlock, Floats, float]], disturbance: Disturbance) -> str:
    """Return the text of a table cell: the means over the runs of a group."""
    scores = []
    for cell, samples, truth, initial_soc in runs_of_group:
        trace = run_with_disturbance(Estimator(cell, initial_soc=initial_soc), samples, disturbance)
        true_soc = np.interp(trace["time_s"], samples["time_s"], truth)
        result = score(trace["time_s"], trace["soc"], trace["soc_std"], true_soc)
        scores += [] if result is None else [(result.rmse, result.cover, result.score)]
    rmse, cover, interval_score = np.mean(scores, axis=0)
    return f"{rmse:.1f}/{cover:.0f}/{interval_score:.1f}"


def main() -> None:
    """Print the table of the groups whose name contains an argument, or of ``DEFAULT_GROUPS``."""
    groups = [g for g in chosen(GROUPS, sys.argv[1:]) if sys.argv[1:] or g.name in DEFAULT_GROUPS]
    table = Table(title="through kills, restarts and gaps: RMSE / inside / score in %")
    table.add_column("")
    for group in groups:
        table.add_column(group.name, justify="right")
    with tempfile.TemporaryDirectory() as folder:
        for disturbance in DISTURBANCES:
            table.add_row(disturbance.name, *(table_cell(runs(group, Path(folder)), disturbance) for group in groups))
    Console(width=None if sys.stdout.isatty() else 160).print(table)


if __name__ == "__main__":
    main()
