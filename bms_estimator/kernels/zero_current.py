"""A sensor that shows no current while the pack rests is right: it takes a coincidence to hide an offset.

What is shown is true current and offset together. That both are zero is common, that one makes up for the other is not.
A rest that shows 50 mA tells nothing: they may be the sensor's, or those of a load that stays on. How small a current a
sensor shows at all, behind its steps and its dead band, is seen from the smallest that it has shown.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

from numba import njit

from bms_estimator.kernels.ekf import learn
from bms_estimator.kernels.ekf_state import OFFSET
from bms_estimator.kernels.state import Record

REST_C, REST_S = 0.01, 60.0
"""Less than this, second by second, for so long is a rest [C, s] ..."""
ZERO_C = 0.002
"""... and shows no current when its mean is below this [C]."""
FORGOTTEN = 1.1
"""The offset is not learned again before its variance has grown to so many times what a rest leaves."""


@njit(cache=True)
def watch_smallest(s: Record, current_a: float) -> None:
    """Keep the smallest current that was shown and is not 0."""
    if current_a != 0.0 and (s.smallest_a == 0.0 or abs(current_a) < s.smallest_a):
        s.smallest_a = abs(current_a)


@njit(cache=True)
def learn_from_zero(s: Record, p: Record) -> None:
    """Once a rest has shown no current, every hypothesis knows the offset to ``p.zero_std_c``, or to what may be hidden."""
    w, one_c = s.window, p.capacity_as / 3600.0
    if w.gap or not abs(w.charge_as) <= REST_C * one_c * w.time_s:
        s.rest_s = s.rest_as = 0.0
        return
    s.rest_s += w.time_s
    s.rest_as += w.charge_as
    if s.rest_s < REST_S or s.smallest_a == 0.0 or abs(s.rest_as) > ZERO_C * one_c * s.rest_s:
        return
    hidden_a = max(s.smallest_a, p.current_step_a, p.dead_band_a)
    left_a2 = (p.zero_std_c * one_c) ** 2 + hidden_a * hidden_a / 3.0
    for q in range(s.count):
        known_a2 = s.covariance[q, OFFSET, OFFSET]
        if known_a2 > FORGOTTEN * left_a2:
            learn(s, q, OFFSET, s.rest_as / s.rest_s, known_a2 * left_a2 / (known_a2 - left_a2))
