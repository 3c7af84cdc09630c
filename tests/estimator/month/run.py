"""Run of the estimator over simulated weeks, scored day by day."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.accuracy import Accuracy, Window
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.cases import Case

AFTER_S = 900.0
"""Time after switch-on that is not scored [s]."""
FULL_SOC = 0.99
"""SOC at which a charge counts as full."""
UNSEEN_CHARGES = ("bicycle",)
"""Uses whose charges happen while the electronics are off. A charge current above ``FULL_SOC`` is then regeneration."""
BLOCK = 100_000
"""Number of samples between two copies of the trace. It limits the memory, because a row of the trace takes 200 bytes."""


@dataclass(frozen=True)
class Day:
    """Result of one day."""

    number: int
    """1 for the first day."""
    score: Score | None
    """None if too few samples can be scored."""
    capacity_ratio: float
    """Learned capacity at the end of the day divided by the true one."""
    capacity_std: float
    """Std of the learned capacity divided by the true capacity."""
    bound: float
    """Lower bound of the std of the SOC, as a mean over the window of SOCs that was passed until the end of the day
    (``bms_estimator.pack_model.accuracy``)."""


def run(case: Case, data: Path) -> list[Day]:
    """Return the results of each day on which the electronics were on."""
    recording = case.draw(data)
    samples, truth = recording.samples, recording.truth
    estimator = Estimator(recording.cell, voltage_resolution_v=case.source.volt_step, sampling=case.source.sampling)
    slow_fit = SlowFit(estimator, interval_s=DAY_S)
    results: list[Day] = []
    cell = CellCurves(estimator.cell_file_settings)
    for number in range(case.days):
        begin, end = np.searchsorted(samples["time_s"], (number * DAY_S, (number + 1) * DAY_S))
        if begin == end:
            continue
        time_s, soc, soc_std = run_blocks(slow_fit, samples[begin:end])
        true_soc = truth["soc"][np.searchsorted(samples["time_s"], time_s)]
        result = score(time_s, soc, soc_std, true_soc, 0.0 if results else AFTER_S)
        learned = relative_capacity(estimator.record[0])
        to_true = recording.declared_ah / truth["capacity_ah"][end - 1]
        results.append(
            Day(number + 1, result, learned.value * to_true, learned.std * to_true, bound_of(case, cell, truth[:end]))
        )
    return results


def bound_of(case: Case, cell: CellCurves, truth: np.ndarray) -> float:
    """Return the lower bound of the std of the SOC for the SOCs of a history, with a full charge if the estimator sees one."""
    soc = truth["soc"]
    is_full = (soc > FULL_SOC) & (truth["current_a"] < 0.0)
    full = case.use not in UNSEEN_CHARGES and bool(is_full.any())
    return Accuracy(cell, Window(float(soc.min()), float(soc.max()), full=full)).mean_std


def run_blocks(slow_fit: SlowFit, samples: SampleBlock) -> tuple[Floats, Floats, Floats]:
    """Run the estimator over samples, and return time, SOC and std of the SOC at each accepted sample."""
    parts, pack = [], Pack(slow_fit.estimator, slow_fit)
    for begin in range(0, samples.size, BLOCK):
        trace = pack.run(samples[begin : begin + BLOCK]).trace
        parts.append([trace[name].copy() for name in ("time_s", "soc", "soc_std")])
    time_s, soc, soc_std = np.concatenate(parts, axis=1)
    return time_s, soc, soc_std
