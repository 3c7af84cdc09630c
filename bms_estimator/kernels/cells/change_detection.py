"""Detection of changes that the filter of a cell does not expect: generalized likelihood ratios of its innovations.

A. Willsky and H. Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems",
IEEE Transactions on Automatic Control 21 (1976), pages 108-112. The hypotheses are RISE and FALL of the self-discharge, and DRAIN
by a balancer. ``response`` is the error that the filter's state would have, had a change of size 1 begun at the last restart of
the hypothesis. Without a change, the innovations are white, and ``score`` over the root of ``information`` has a standard normal
distribution, so that the threshold needs no training.

``c`` is a record of CELL, ``b`` of BANK_STATE.
"""

import math

from bms_estimator.kernels.cells.cell_filter import advance, expected_v
from bms_estimator.kernels.cells.records import DRAIN, FALL, HYPOTHESES, LEAK, RISE, SOC, STATES
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

MIN_CHANGE_C = 2e-5
"""Minimum change of the self-discharge current, as a C-rate [1/h]: 1.4 % a month, less than ``LEAK_STD`` of an intact cell. A
hypothesis with a smaller estimate starts again."""
MIN_CHANGE_FRACTION = 0.3
"""Minimum change relative to the present self-discharge. Old hypotheses would otherwise hide the end of a short."""
THRESHOLD_STD = 4.0
"""Minimum significance of a change, in std."""
END_STD = 2.0
"""Minimum significance of a fall, which ends an alarm and never raises one, in std."""
MIN_INFORMATION = 1e4
"""Minimum information [h^2]: the change has a std of at most C/100. With less, a single wrong
innovation would look like a large short."""
DRAIN_MARGIN = 9.0
"""Minimum excess of the likelihood ratio (twice its logarithm) of a self-discharge over that of a balancer."""


@njit(cache=True)
def restart_hypothesis(c: Record, h: int) -> None:
    """Start a hypothesis again: its change begins now."""
    for i in range(STATES):
        c.response[h, i] = 0.0
    c.response[h, LEAK] = 1.0 if h == RISE else -1.0 if h == FALL else 0.0
    c.score[h] = c.information[h] = 0.0


@njit(cache=True)
def predict_hypotheses(c: Record, b: Record, balancing: bool) -> None:
    """Advance the responses over the window ``b``. ``balancing`` is True if a balancer may be active."""
    for h in range(HYPOTHESES):
        advance(c.response[h], b)
    if balancing:
        c.response[DRAIN, SOC] -= b.elapsed_s / 3600.0


@njit(cache=True)
def update_hypotheses(
    c: Record, slope_v: float, drop_v: float, innovation_v: float, variance_v2: float, balancing: bool, ph: Floats
) -> None:
    """Add an innovation, which also corrects the filter, to the likelihoods of the hypotheses.

    Args:
        c: The cell; updated.
        slope_v: Derivative of the deviation by the cell's SOC [V].
        drop_v: Overpotential of the reference cell [V].
        innovation_v: Innovation [V].
        variance_v2: Variance S of the innovation [V^2].
        balancing: True if a balancer may be active. Its current is unknown, so that the innovation is not evaluated.
        ph: P H', shape (STATES,).
    """
    min_change_c = max(MIN_CHANGE_C, MIN_CHANGE_FRACTION * abs(c.mean[LEAK]))
    for h in range(HYPOTHESES):
        response = c.response[h]
        change_v = expected_v(response, slope_v, drop_v)
        if not balancing:
            c.score[h] += change_v * innovation_v / variance_v2
            c.information[h] += change_v * change_v / variance_v2
        for i in range(STATES):
            response[i] -= ph[i] / variance_v2 * change_v
        if balancing and h == DRAIN:  # its response grows while a balancer may be active; a restart would discard it
            continue
        is_too_small = not c.score[h] > min_change_c * c.information[h]  # also if it is not finite
        if is_too_small or (h == FALL and c.mean[LEAK] < MIN_CHANGE_C):  # without a self-discharge nothing can fall
            restart_hypothesis(c, h)


@njit(cache=True)
def significance(c: Record, h: int) -> float:
    """Return the significance of a hypothesis [std]."""
    return c.score[h] / math.sqrt(c.information[h]) if c.information[h] > MIN_INFORMATION else 0.0


@njit(cache=True)
def apply_changes(c: Record) -> None:
    """Correct the state of the filter by the most likely hypothesis, if it is significant."""
    rise, fall, drain = significance(c, RISE), significance(c, FALL), significance(c, DRAIN)
    best = RISE
    if drain >= rise and drain >= fall:
        best = DRAIN
    elif fall > rise:
        best = FALL
    threshold = END_STD if best == FALL else THRESHOLD_STD
    if max(rise, fall, drain) < threshold or (best == RISE and rise**2 - drain**2 < DRAIN_MARGIN):
        return
    response, change = c.response[best], c.score[best] / c.information[best]
    for i in range(STATES):
        c.mean[i] += change * response[i]
        for j in range(STATES):
            c.covariance[i, j] += response[i] * response[j] / c.information[best]
    for h in range(HYPOTHESES):
        restart_hypothesis(c, h)
