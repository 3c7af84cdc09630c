"""Score of an estimator with a cell: replays that start in mid-load, with an SOC too low and too high.

The measure is the interval score of the band SOC +- 2 std (Gneiting and Raftery, JASA 102 (2007) 359): its width, and
forty times what the truth lies outside. Neither a wider nor a narrower band than is true betters it.
"""

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SAMPLE

CUTS = (0.2, 0.5)
"""Parts of the charge moved after which a replay begins."""
WRONG_SOC = (-0.2, 0.2)
"""Errors of the initial SOC."""
SETTLED_S = 900.0
"""Time after the start from which on a replay is scored [s]."""
MIN_S = 900.0
"""Minimum scored time [s]."""
LOWEST_SOC = 0.05
"""Minimum scored SOC."""
OUTSIDE = 40.0
"""Weight of what lies outside a band of 95 %."""


def interval_score(cell: CellModel, load: CleanCapture, soc: Floats) -> float:
    """Mean over the replays, in percent of SOC; NaN when none is long enough.

    Args:
        cell: Cell that the estimator uses.
        load: The capture.
        soc: Shape (n,), the truth.
    """
    moved = np.cumsum(np.abs(load.current_a) * np.diff(load.time_s, append=load.time_s[-1]))
    starts = [int(np.argmax(moved >= cut * moved[-1])) for cut in CUTS]
    found = [_one(cell, load, soc, start, wrong) for start in starts for wrong in WRONG_SOC]
    judged = [score for score in found if np.isfinite(score)]
    return float(np.mean(judged)) if judged else float("nan")


def _one(cell: CellModel, load: CleanCapture, soc: Floats, start: int, wrong: float) -> float:
    samples = np.zeros(load.time_s.size - start, dtype=SAMPLE)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        samples[name] = getattr(load, name)[start:]
    trace = Estimator(cell, initial_soc=float(np.clip(soc[start] + wrong, 0.0, 1.0))).run(samples)
    true_soc = np.interp(trace["time_s"], load.time_s, soc)
    judged = (trace["time_s"] - load.time_s[start] >= SETTLED_S) & (true_soc >= LOWEST_SOC)
    step_s = np.clip(np.diff(trace["time_s"], append=trace["time_s"][-1]), 0.0, 60.0)[judged]
    if step_s.sum() < MIN_S:
        return float("nan")
    std = trace["soc_std"][judged]
    beyond = np.maximum(np.abs(trace["soc"][judged] - true_soc[judged]) - 2.0 * std, 0.0)
    return 100.0 * float((step_s * (4.0 * std + OUTSIDE * beyond)).sum() / step_s.sum())
