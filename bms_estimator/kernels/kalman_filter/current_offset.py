"""Update of the current sensor's offset at rest.

The sensor reports the sum of true current and offset. If it reports zero, both are almost certainly zero, because a load
rarely cancels the offset. A rest with a report of 50 mA gives no information, because the current may be an offset or a
load. The smallest current reported so far bounds the dead band and the resolution of the sensor.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

from bms_estimator.kernels.kalman_filter.ekf import update_state_directly
from bms_estimator.kernels.kalman_filter.records import OFFSET
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

REST_C = 0.01
"""Maximum mean current of a window at rest, as a C-rate."""
REST_S = 60.0
"""Minimum duration of a rest [s]."""
ZERO_C = 0.002
"""Maximum mean current of a rest at which the current counts as zero, as a C-rate."""
MIN_VARIANCE_RATIO = 4.0
"""Minimum ratio of the variance of the offset to the variance of the offset measured in a rest, for an update.
Successive rests have a common error, so that a rest does not update the offset again before its variance has grown."""


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
