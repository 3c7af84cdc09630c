"""A sensor that shows no current while the pack rests is right: it takes a coincidence to hide an offset.

The sensor shows the sum of true current and offset. That both are zero is common, that one makes up for the other is
not.
A rest that shows 50 mA gives no information: it may be the sensor's offset or a load. How small a current a
sensor shows at all, behind its steps and its dead band, is seen from the smallest that it has shown.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

from bms_estimator.kernels.kalman_filter.ekf import update_state_directly
from bms_estimator.kernels.kalman_filter.records import OFFSET
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

REST_C, REST_S = 0.01, 60.0
"""Maximum current, second by second [C], and minimum duration [s] of a rest."""
ZERO_C = 0.002
"""Maximum mean current of a rest at which the current counts as zero [C]."""
FORGOTTEN = 4.0
"""Growth of the offset's variance since a rest after which the next rest updates it again. Successive rests have a
common error."""


@njit(cache=True)
def track_smallest_current(s: Record, current_a: float) -> None:
    """Keep the smallest current that was shown twice in a row and is not 0: one sample may be the mean over an edge."""
    shown_a = max(abs(current_a), abs(s.current_a))
    if current_a != 0.0 and s.current_a != 0.0 and (s.smallest_a == 0.0 or shown_a < s.smallest_a):
        s.smallest_a = shown_a


@njit(cache=True)
def update_offset_at_rest(s: Record, p: Record) -> None:
    """Update the offset of every hypothesis after each minute of rest, to ``p.zero_std_c`` or the hidden current.

    What little it shows may be the sensor's or that of a load: half of it is the offset, give or take the other half.
    """
    w, one_c = s.window, p.capacity_as / 3600.0
    moved_as2 = w.charge_as * w.charge_as + w.between_as2 + w.unknown_as * w.unknown_as
    if not moved_as2 <= (REST_C * one_c * w.time_s) ** 2:
        s.rest_s = s.rest_as = 0.0
        return
    s.rest_s += w.time_s
    s.rest_as += w.charge_as
    if s.rest_s < REST_S:
        return
    half_a = 0.5 * s.rest_as / s.rest_s
    s.rest_s = s.rest_as = 0.0
    if s.smallest_a == 0.0 or abs(half_a) > 0.5 * ZERO_C * one_c:
        return
    hidden_a = max(s.smallest_a, p.current_step_a, p.dead_band_a)
    left_a2 = (p.zero_std_c * one_c) ** 2 + hidden_a * hidden_a / 3.0 + half_a * half_a
    for q in range(s.count):
        known_a2 = s.covariance[q, OFFSET, OFFSET]
        if known_a2 > FORGOTTEN * left_a2:
            update_state_directly(s, q, OFFSET, half_a, known_a2 * left_a2 / (known_a2 - left_a2))
