"""Window of about a second of samples, whose mean is one measurement of the filter.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.current_interpolation import (
    RAMP_STEP_S,
    interpolated_current,
    ramp_correction,
)
from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    TAUS,
)
from bms_estimator.kernels.kalman_filter.current_offset import track_smallest_current
from bms_estimator.kernels.kalman_filter.ekf import transition_diagonal
from bms_estimator.kernels.kalman_filter.gap_charge import (
    SKEW_VARIANCE,
    expected_excess_charge,
    gap_charge_std,
    interpolation_charge_variance,
    rounding_charge_variance,
)
from bms_estimator.kernels.kalman_filter.temperature import (
    MAX_RATE_K_S,
    RATE_LIMIT_DELAY_S,
    TEMPERATURE_S,
    propagate_self_heating,
)
from bms_estimator.model.arrays import Record
from bms_estimator.model.unmeasured_time import MAX_FLOW_S
from bms_estimator.numba_cache import njit

WINDOW_S = 0.99
"""Minimum duration of a window [s]. Each sample of a 1 Hz source is a window."""
DECAY_TOLERANCE = 0.005
"""Relative change of the sample period below which the decays of the RC pairs are not computed again."""


@njit(cache=True)
def reset_window(s: Record) -> None:
    """Begin a new window."""
    w = s.window
    w.samples = w.gap = 0
    w.time_s = w.charge_as = w.throughput_as = w.unknown_as = w.between_as2 = w.rounded_as2 = 0.0
    w.skew_a2 = w.sum_v = w.sum_a = w.sum_as = 0.0
    w.sum_x_a[:] = 0.0


@njit(cache=True)
def integrate_current(s: Record, p: Record, dt_s: float, gap: bool, current_a: float, temperature_c: float) -> None:
    """Integrate the current from the previous sample to this one: charge, RC pairs, and their variances.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        dt_s: Time since the previous sample [s].
        gap: True if samples are missing since the previous sample.
        current_a: Current of this sample [A].
        temperature_c: Temperature of the cell [C]; NaN without a sensor.
    """
    if math.isfinite(temperature_c):
        share = min(1.0, dt_s / TEMPERATURE_S) if s.sensed else 1.0
        max_change_k = MAX_RATE_K_S * dt_s if s.sensed and s.seeded_s > RATE_LIMIT_DELAY_S else math.inf
        s.temperature_c += min(max(share * (temperature_c - s.temperature_c), -max_change_k), max_change_k)
        s.sensed = 1
    w = s.window
    held_a, change_a = interpolated_current(dt_s, s.current_a, current_a, p.unmeasured_s), current_a - s.current_a
    unmeasured = gap or dt_s > p.unmeasured_s
    charge_as = held_a * min(dt_s, MAX_FLOW_S)
    if gap and dt_s > p.unmeasured_s:
        charge_as += expected_excess_charge(s, held_a, dt_s)
        held_a = charge_as / dt_s
    if abs(dt_s - s.decay_s) > DECAY_TOLERANCE * dt_s:
        s.decay_s = dt_s
        for k in range(BRANCHES):
            s.decay[k] = math.exp(-dt_s / TAUS[k])
    for k in range(BRANCHES):
        s.x_a[k] = held_a + (s.x_a[k] - held_a) * s.decay[k]
        if dt_s > RAMP_STEP_S and not unmeasured:
            s.x_a[k] += ramp_correction(change_a, dt_s / TAUS[k], s.decay[k])
    w.time_s += dt_s
    w.charge_as += charge_as
    w.throughput_as += abs(charge_as)
    if gap:
        w.gap = 1
    if unmeasured:
        w.unknown_as += gap_charge_std(s, p, held_a, dt_s)
    else:
        w.between_as2 += interpolation_charge_variance(change_a, dt_s)
    if p.current_step_a > 0.0 or p.dead_band_a > 0.0:
        w.rounded_as2 += rounding_charge_variance(s, p, dt_s, current_a)
    s.soc = min(max(s.soc - charge_as / p.capacity_as, 0.0), 1.0)
    track_smallest_current(s, current_a)
    s.current_a = current_a


@njit(cache=True)
def add_to_window(s: Record, current_a: float, voltage_v: float) -> None:
    """Add a sample to the window."""
    w = s.window
    w.samples += 1
    w.sum_v += voltage_v
    w.sum_a += current_a
    w.sum_as += w.charge_as
    for k in range(BRANCHES):
        w.sum_x_a[k] += s.x_a[k]


@njit(cache=True)
def widen_by_interpolation(w: Record, change_a: float, age_s: float, dt_s: float) -> None:
    """Add the variances of a sample whose current is interpolated between two measured ones. Call before ``integrate_current``.

    Args:
        w: Record of WINDOW.
        change_a: Change between the measured currents [A].
        age_s: Time from the first measured current to the sample [s].
        dt_s: Time between the measured currents [s].
    """
    fraction, rest_s = age_s / dt_s, dt_s - age_s
    w.skew_a2 += SKEW_VARIANCE * fraction * (1.0 - fraction) * change_a * change_a
    # ``integrate_current`` counts the two parts of the step as if both changes were measured
    counted_as2 = interpolation_charge_variance(fraction * change_a, age_s)
    counted_as2 += interpolation_charge_variance((1.0 - fraction) * change_a, rest_s)
    w.between_as2 += interpolation_charge_variance(change_a, dt_s) - counted_as2


@njit(cache=True)
def prepare_transition(s: Record, p: Record) -> None:
    """Propagate the temperature over the window if it is not measured, and compute F."""
    if not s.sensed:
        propagate_self_heating(s, p)
    transition_diagonal(s, p)
