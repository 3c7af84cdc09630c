"""Score of an estimator with a cell. Replays start in mid-load with an initial SOC that is too low or too high.

The measure is the interval score of SOC +- 2 std (Gneiting and Raftery, JASA 102 (2007) 359). It is the width of the
interval plus 40 times the distance of the true SOC outside the interval. The score is proper: its expected value is
smallest for the true interval.
"""

import numpy as np

from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import SAMPLE, Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.charge_count import step_charges_as
from bms_estimator.model.progress import Progress, no_progress

START_FRACTIONS = (0.2, 0.5)
"""Fractions of the capture's charge throughput at which replays start."""
INITIAL_SOC_ERRORS = (-0.2, 0.2)
"""Errors of the initial SOC."""
SETTLING_S = 900.0
"""Time after the start of a replay that is not scored [s]."""
MIN_SCORED_S = 900.0
"""Minimum scored time [s]."""
MIN_SOC = 0.05
"""Minimum scored SOC."""
MAX_STEP_S = 60.0
"""Maximum weight of a sample in a mean over time [s], so that a gap in the capture does not dominate."""
PENALTY = 40.0
"""Weight of the distance outside the interval, 2 / alpha, with alpha = 0.05 for an interval of 95 %."""


def interval_score(cell: CellModel, capture: CleanCapture, soc: Floats, progress: Progress = no_progress) -> float:
    """Return the mean score of the replays of a capture [% of SOC]; NaN when none is long enough.

    Args:
        cell: Cell that the estimator uses.
        capture: The capture.
        soc: Shape (n,), true SOC.
        progress: Receives the finished fraction after each replay.
    """
    throughput_as = np.cumsum(np.append(np.abs(step_charges_as(capture.time_s, capture.current_a)), 0.0))
    start_indices = [int(np.argmax(throughput_as >= fraction * throughput_as[-1])) for fraction in START_FRACTIONS]
    starts = [(start, error) for start in start_indices for error in INITIAL_SOC_ERRORS]
    scores = []
    for start, error in starts:
        scores.append(_replay_score(cell, capture, soc, start, error))
        progress(len(scores) / len(starts))
    finite = [score for score in scores if np.isfinite(score)]
    return float(np.mean(finite)) if finite else float("nan")


def _replay_score(cell: CellModel, capture: CleanCapture, soc: Floats, start: int, soc_error: float) -> float:
    """Return the score of one replay [%]. It starts at sample ``start`` with an initial SOC error of ``soc_error``."""
    samples = np.zeros(capture.time_s.size - start, dtype=SAMPLE)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        samples[name] = getattr(capture, name)[start:]
    trace = Estimator(cell, initial_soc=float(np.clip(soc[start] + soc_error, 0.0, 1.0))).run(samples)
    true_soc = np.interp(trace["time_s"], capture.time_s, soc)
    scored = (trace["time_s"] - capture.time_s[start] >= SETTLING_S) & (true_soc >= MIN_SOC)
    step_s = np.clip(np.diff(trace["time_s"], append=trace["time_s"][-1]), 0.0, MAX_STEP_S)[scored]
    if step_s.sum() < MIN_SCORED_S:
        return float("nan")
    std = trace["soc_std"][scored]
    outside = np.maximum(np.abs(trace["soc"][scored] - true_soc[scored]) - 2.0 * std, 0.0)
    return 100.0 * float((step_s * (4.0 * std + PENALTY * outside)).sum() / step_s.sum())
