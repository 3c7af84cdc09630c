"""Open-loop response of a cell's RC pairs to a measured current, from rest.

Numbers in parentheses are equations of the thesis.

The current between two samples is interpolated (``interpolated_current``, ``ramp_correction``) as in the filter for a source
with a period of at most a minute.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, r_s, r_tl, r_ts, rc_step
from bms_estimator.kernels.cell_model.current_interpolation import (
    RAMP_STEP_S,
    interpolated_current,
    ramp_correction,
)
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TAUS, TREND_PAIR
from bms_estimator.model.arrays import Floats
from bms_estimator.model.unmeasured_time import UNMEASURED_S
from bms_estimator.numba_cache import njit

MIN_CAPACITANCE = 1e-3
"""Lower limit of C_ts and C_tl, as fractions of their offsets a9 and a12, because (2.7) and (2.8) are negative near empty."""


@njit(cache=True)
def branch_currents(time_s: Floats, current_a: Floats) -> Floats:
    """Filter the current with each time constant of the RC ladder, from rest.

    Args:
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), discharge positive [A].

    Returns:
        x_k at each sample, shape (n, BRANCHES) [A].
    """
    return branch_currents_from(np.zeros(BRANCHES), time_s, current_a)


@njit(cache=True)
def branch_currents_from(first_a: Floats, time_s: Floats, current_a: Floats) -> Floats:
    """Return ``branch_currents`` with the values ``first_a`` at the first sample, shape (BRANCHES,) [A]."""
    x = np.zeros((time_s.size, BRANCHES))
    x[0] = first_a
    for j in range(1, time_s.size):
        dt_s = time_s[j] - time_s[j - 1]
        mean_a = interpolated_current(dt_s, current_a[j - 1], current_a[j])
        ramp_a = current_a[j] - current_a[j - 1] if RAMP_STEP_S < dt_s <= UNMEASURED_S else 0.0
        for k in range(BRANCHES):
            decay = math.exp(-dt_s / TAUS[k])
            x[j, k] = mean_a + (x[j - 1, k] - mean_a) * decay + ramp_correction(ramp_a, dt_s / TAUS[k], decay)
    return x


@njit(cache=True)
def hysteresis(time_s: Floats, soc: Floats, length: float, first: float) -> Floats:
    """Return the hysteresis state h, which approaches 1 during a charge and -1 during a discharge.

    As in the filter, h follows the SOC filtered with the time constant of RC pair ``TREND_PAIR``.

    Args:
        time_s: Shape (n,), increasing [s].
        soc: SOC by coulomb counting, shape (n,).
        length: Charge constant of the exponential approach to 1 or -1 [SOC].
        first: h at the first sample.

    Returns:
        h, shape (n,).
    """
    h = np.full(soc.size, first)
    filtered_soc = soc[0]
    for j in range(1, soc.size):
        change = (1.0 - math.exp(-(time_s[j] - time_s[j - 1]) / TAUS[TREND_PAIR])) * (soc[j] - filtered_soc)
        filtered_soc += change
        decay = math.exp(-abs(change) / length)
        h[j] = decay * h[j - 1] + math.copysign(1.0 - decay, change)
    return h


@njit(cache=True)
def two_branches(time_s: Floats, current_a: Floats, soc: Floats, a: Floats) -> Floats:
    """Return the overpotential (2.2)-(2.9) with the ohmic drop, under a current that is constant between samples.

    Below SOC 0 the elements are those at 0, because their exponentials diverge.

    Args:
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), discharge positive [A].
        soc: SOC by coulomb counting, shape (n,).
        a: a1..a15 at index 1..15.

    Returns:
        Overpotential, shape (n,) [V].
    """
    drop_v = np.empty(time_s.size)
    v_ts = v_tl = 0.0
    for j in range(time_s.size):
        if j > 0:
            dt_s, held_a, mid_soc = time_s[j] - time_s[j - 1], current_a[j - 1], max(0.5 * (soc[j - 1] + soc[j]), 0.0)
            ohm_ts, ohm_tl = r_ts(mid_soc, a), r_tl(mid_soc, a)
            farad_ts = max(c_ts(mid_soc, a), MIN_CAPACITANCE * a[9])
            farad_tl = max(c_tl(mid_soc, a), MIN_CAPACITANCE * a[12])
            v_ts = rc_step(v_ts, held_a, ohm_ts, ohm_ts * farad_ts, dt_s)
            v_tl = rc_step(v_tl, held_a, ohm_tl, ohm_tl * farad_tl, dt_s)
        drop_v[j] = v_ts + v_tl + current_a[j] * r_s(max(soc[j], 0.0), a)
    return drop_v
