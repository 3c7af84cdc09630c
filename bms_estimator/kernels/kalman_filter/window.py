"""Window of about a second of samples, whose mean is one measurement of the filter.

Charge that was not measured adds to the window an expected value and a std: in gaps, between runs of the service, and between
slow or rounded samples. For a gap, both follow from the load before it.

Without a temperature sensor, the cell's temperature follows from the losses in the window.

In a rest, the current sensor's offset is updated. The sensor reports the sum of true current and offset. If it reports zero,
both are almost certainly zero, because a load rarely cancels the offset. A rest with a report of 50 mA gives no information,
because the current may be an offset or a load. The smallest current reported so far bounds the dead band and the resolution of
the sensor.

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
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    TAUS,
    arrhenius,
    resistances,
)
from bms_estimator.kernels.kalman_filter.ekf import transition_diagonal, update_state_directly
from bms_estimator.kernels.kalman_filter.records import (
    LN_R,
    LN_R0,
    OFFSET,
    X,
)
from bms_estimator.model.arrays import Record
from bms_estimator.model.unmeasured_time import MAX_FLOW_S
from bms_estimator.numba_cache import njit

WINDOW_S = 0.99
"""Minimum duration of a window [s]. Each sample of a 1 Hz source is a window."""
DECAY_TOLERANCE = 0.005
"""Relative change of the sample period below which the decays of the RC pairs are not computed again."""
TEMPERATURE_S = 10.0
"""Averaging time of a temperature sensor's noise [s]."""
MAX_RATE_K_S = 0.1
"""Maximum rate of change of a cell's temperature [K/s]."""
RATE_LIMIT_DELAY_S = 60.0
"""Delay until the rate limit of the temperature applies [s], because some sensors report 85 C at first."""
HEAT_J = 22.0
"""Heat capacity per Ah of a cell [J/(K Ah)]. Fits to an LG M50 at C/2 and 1C give 22 and 24 J/(K Ah)."""
COOLING_S = 600.0
"""Time constant of a cell's cooling in still air [s]. Fits to an LG M50 at C/2 and 1C give 650 and 570 s."""
MAX_MODELLED_C = 80.0
"""Maximum modelled temperature [C], so that a wrong current does not cause an implausible temperature for an hour."""
REST_C = 0.01
"""Maximum mean current of a window at rest, as a C-rate."""
REST_S = 60.0
"""Minimum duration of a rest [s]."""
ZERO_C = 0.002
"""Maximum mean current of a rest at which the current counts as zero, as a C-rate."""
MIN_VARIANCE_RATIO = 4.0
"""Minimum ratio of the variance of the offset to the variance of the offset measured in a rest, for an update.
Successive rests have a common error, so that a rest does not update the offset again before its variance has grown."""
PRESENT_LOAD_S = 600.0
"""Averaging time of the present load, and expected duration of that load in a gap [s]."""
LONG_TERM_S = 6.0 * 3600.0
"""Averaging time of the long-term mean load, which is expected after the present one in a long gap [s]."""
INTERPOLATION_VARIANCE = 0.2
"""Variance of the mean current between two samples by linear interpolation, divided by the squared change of the current
between the samples. It is 1/12 for loads that last much longer than a sample period, 0.10 and 0.18 for loads of 20 s sampled
every 10 s and every 60 s, and 1/4 for independent samples."""
SKEW_VARIANCE = 2.0
"""Variance of the current between two samples about the straight line, divided by f (1 - f) and by the squared change of the
current between the samples. f is the fraction of the time that has passed. The ratio is 1 for one step at a random time, and 3
for independent values. In the middle between samples 10 s and 60 s apart, a load whose levels last 20 s has 1.2 and 2.2."""
MAX_EQUAL_STEPS = 1.5
"""Maximum difference between two reported currents that count as equal, in steps of the resolution."""
MIN_UNMEASURED_STD_C = 0.1
"""Minimum std of an unmeasured current, as a C-rate: a multiple of the current that empties the cell in an hour."""
RESTING_C = 0.1
"""Maximum mean current over 10 min of a resting pack, as a C-rate."""


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


@njit(cache=True)
def propagate_self_heating(s: Record, p: Record) -> None:
    """Model the temperature at the end of the window by losses i^2 R_0 + sum x_k^2 R_k, in air of ``REFERENCE_C``."""
    w, x = s.window, s.mean[s.best]
    resistances(s.soc, p.weak_ohm, p.strong_ohm, s.weak, s.strong, s.ohm)
    current_a = w.charge_as / w.time_s
    loss_w = math.exp(x[LN_R0]) * s.ohm[0] * current_a * current_a
    for k in range(BRANCHES):
        loss_w += math.exp(x[LN_R]) * s.ohm[1 + k] * (s.x_a[k] + x[X + k]) ** 2
    steady_c = REFERENCE_C + loss_w / p.series * COOLING_S / (HEAT_J * p.capacity_as / 3600.0)
    s.temperature_c = steady_c + (s.temperature_c - steady_c) * math.exp(-w.time_s / COOLING_S)
    s.temperature_c = min(s.temperature_c, MAX_MODELLED_C)


@njit(cache=True)
def update_arrhenius_factors(s: Record) -> None:
    """Compute the Arrhenius factors at the cell's temperature."""
    s.weak, s.strong = (
        arrhenius(LOW_ACTIVATION_ENERGY, s.temperature_c),
        arrhenius(HIGH_ACTIVATION_ENERGY, s.temperature_c),
    )
    s.hysteresis = arrhenius(HYSTERESIS_ACTIVATION_ENERGY, s.temperature_c)


@njit(cache=True)
def track_smallest_current(s: Record, current_a: float) -> None:
    """Store the smallest nonzero current reported twice in succession. A single sample may be a mean over a step."""
    reported_a = max(abs(current_a), abs(s.current_a))
    if current_a != 0.0 and s.current_a != 0.0 and (s.smallest_a == 0.0 or reported_a < s.smallest_a):
        s.smallest_a = reported_a


@njit(cache=True)
def update_offset_at_rest(s: Record, p: Record) -> None:
    """Update the offset of every hypothesis after each minute of rest.

    A small mean current may be offset or load. The measured offset is therefore half of this current. Its variance is the sum
    of the squares of this half, of ``p.zero_std_c``, and of the std of a current hidden by resolution or dead band.
    """
    w, one_c = s.window, p.capacity_as / 3600.0
    moved_as2 = w.charge_as * w.charge_as + w.between_as2 + w.unknown_as * w.unknown_as
    if not moved_as2 <= (REST_C * one_c * w.time_s) ** 2:  # also for NaN
        s.rest_s = s.rest_as = 0.0
        return
    s.rest_s += w.time_s
    s.rest_as += w.charge_as
    if s.rest_s < REST_S:
        return
    half_a = 0.5 * s.rest_as / s.rest_s
    s.rest_s = s.rest_as = 0.0
    # before the first nonzero current, the dead band and the resolution are unknown
    if s.smallest_a == 0.0 or abs(half_a) > 0.5 * ZERO_C * one_c:
        return
    hidden_a = max(s.smallest_a, p.current_step_a, p.dead_band_a)
    measured_a2 = (p.zero_std_c * one_c) ** 2 + hidden_a * hidden_a / 3.0 + half_a * half_a
    for q in range(s.count):
        offset_a2 = s.covariance[q, OFFSET, OFFSET]
        if offset_a2 > MIN_VARIANCE_RATIO * measured_a2:
            update_state_directly(s, p, q, OFFSET, half_a, offset_a2 * measured_a2 / (offset_a2 - measured_a2))


@njit(cache=True)
def initialize_load_statistics(s: Record, p: Record, current_a: float) -> None:
    """Initialize the load statistics at the first sample with the prior of the load before switch-on.

    That load is the sum of its mean ``load_mean_c``, a part with std ``load_level_c`` that is constant for hours, and a
    varying part with std ``load_c``, all as C-rates. ``s.rms_a2`` is the mean square over 10 min, not its root. The mean of
    the present load is the first sample's current, limited because a large current may be a short peak.
    """
    one_c = p.capacity_as / 3600.0
    s.usual_a = p.load_mean_c * one_c
    s.usual_a2 = (p.load_mean_c**2 + p.load_level_c**2 + p.load_c**2) * one_c * one_c
    limit_a = math.sqrt(s.usual_a2)
    s.mean_a = min(max(current_a, -limit_a), limit_a)
    s.rms_a2 = max(s.mean_a * s.mean_a, (p.load_mean_c * one_c) ** 2)


@njit(cache=True)
def update_load_statistics(s: Record, current_a: float, dt_s: float) -> None:
    """Update mean and mean square of the present and the long-term load by ``current_a`` over ``dt_s``."""
    share = min(1.0, dt_s / PRESENT_LOAD_S)
    s.mean_a += share * (current_a - s.mean_a)
    s.rms_a2 += share * (current_a * current_a - s.rms_a2)
    share = min(1.0, dt_s / LONG_TERM_S)
    s.usual_a += share * (current_a - s.usual_a)
    s.usual_a2 += share * (current_a * current_a - s.usual_a2)


@njit(cache=True)
def expected_excess_charge(s: Record, held_a: float, dt_s: float) -> float:
    """Return the expected charge in a gap of ``dt_s`` beyond ``held_a`` x ``dt_s`` [A s].

    The present load is expected to end at random with the mean duration ``PRESENT_LOAD_S``.

    Args:
        s: Record of EKF_STATE.
        held_a: Current that the caller counts over the gap [A].
        dt_s: Duration of the gap [s].
    """
    return (s.mean_a - held_a) * PRESENT_LOAD_S * (1.0 - math.exp(-dt_s / PRESENT_LOAD_S))


@njit(cache=True)
def gap_charge_std(s: Record, p: Record, held_a: float, dt_s: float) -> float:
    """Return the std of the charge in ``dt_s`` about ``held_a`` x ``dt_s`` [A s].

    The unknown current is assumed constant over the gap. Its distribution changes from the present load in a short gap to
    the long-term load in a long gap.
    """
    present_share = math.exp(-dt_s / PRESENT_LOAD_S)
    present_a2 = s.rms_a2 - 2.0 * held_a * s.mean_a + held_a * held_a
    usual_a2 = s.usual_a2 - 2.0 * held_a * s.usual_a + held_a * held_a
    min_std_a = MIN_UNMEASURED_STD_C * p.capacity_as / 3600.0
    mean_a2 = present_share * present_a2 + (1.0 - present_share) * usual_a2
    return math.sqrt(max(mean_a2, min_std_a * min_std_a)) * dt_s


@njit(cache=True)
def is_resting(s: Record, p: Record) -> bool:
    """Return True if the pack rests: its mean current over 10 min is small."""
    return abs(s.mean_a) < RESTING_C * p.capacity_as / 3600.0


@njit(cache=True)
def interpolation_charge_variance(change_a: float, dt_s: float) -> float:
    """Return the variance of the charge in ``dt_s`` about the straight line between two samples [A^2 s^2].

    Args:
        change_a: Change of the current between the samples [A].
        dt_s: Time between the samples [s].
    """
    return INTERPOLATION_VARIANCE * (change_a * dt_s) ** 2 if dt_s > RAMP_STEP_S else 0.0


@njit(cache=True)
def rounding_charge_variance(s: Record, p: Record, dt_s: float, current_a: float) -> float:
    """Advance the time of equal currents ``s.same_s``, and return the variance that ``dt_s`` adds to the charge [A^2 s^2].

    The variance is due to the resolution of the current. A constant reported current has a constant error, so that the
    variance of its charge grows with the square of the time.
    """
    error_a2 = p.current_step_a * p.current_step_a / 12.0  # variance of rounding
    if current_a == 0.0 and s.current_a == 0.0:
        error_a2 = max(error_a2, p.dead_band_a * p.dead_band_a / 3.0)  # uniform within the dead band
    is_equal = abs(current_a - s.current_a) <= MAX_EQUAL_STEPS * p.current_step_a
    previous_s = s.same_s if is_equal else 0.0
    s.same_s = previous_s + dt_s
    return error_a2 * (s.same_s * s.same_s - previous_s * previous_s)
