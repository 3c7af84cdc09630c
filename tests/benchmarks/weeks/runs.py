"""Runs of the estimator over simulated weeks, with a part of it disabled."""

import itertools
from dataclasses import replace

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.benchmarks.weeks.parts import Part
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import Case, Recording
from tests.estimator.month.groups import mean_score
from tests.estimator.month.run import AFTER_S, run_blocks


def run_without(
    case: Case, recording: Recording, part: Part, interval_s: float = DAY_S
) -> tuple[Floats, Floats, Floats]:
    """Return time [s], SOC and std of the SOC of a run with a part disabled.

    Args:
        case: Case of the recording.
        recording: Samples and truth of the case.
        part: Disabled part.
        interval_s: Interval between two fits [s]; infinite: no fit.
    """
    with part.disabled():
        sampling = replace(case.source.sampling, **part.gains)
        estimator = Estimator(recording.cell, voltage_resolution_v=case.source.volt_step, sampling=sampling)
        part.change_settings(estimator)
        slow_fit = SlowFit(estimator, interval_s=interval_s if part.has_slow_fit else np.inf)
        return run_blocks(slow_fit, recording.samples)


def score_without(case: Case, recording: Recording, part: Part, first_day: int) -> Score | None:
    """Return the mean score of the days from ``first_day`` to the last, with a part disabled."""
    time_s, soc, soc_std = run_without(case, recording, part)
    true_soc = recording.truth["soc"][np.searchsorted(recording.samples["time_s"], time_s)]
    edges = np.searchsorted(time_s, DAY_S * np.arange(first_day - 1, case.days + 1))
    days = [
        score(time_s[a:b], soc[a:b], soc_std[a:b], true_soc[a:b], AFTER_S if a == 0 else 0.0)
        for a, b in itertools.pairwise(edges)
        if b > a
    ]
    return mean_score(day for day in days if day is not None)
