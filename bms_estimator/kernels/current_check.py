"""Check of the current by the voltage, against overflows and damaged values.

A change of the current changes the voltage by at least a part of the ohmic drop. Without that change the sample is doubtful
and waits. The next samples confirm it if the current stays near its level, or if the voltage follows late, because the
device measured it before the current. Otherwise it is rejected. A current just below 65,536 steps of a protocol is rejected
without waiting. It may be a small charge current, a signed number of 16 bits that was read as an unsigned one, and may last.

``d`` is a record of CURRENT_CHECK, ``s`` of ESTIMATOR_STATE, ``p`` of OBSERVER_SETTINGS.
"""

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.kernels.kalman_filter.input_checks import UNUSABLE
from bms_estimator.model.arrays import Record, SampleStatus
from bms_estimator.numba_cache import njit

FOLLOWED_FRACTION = 0.2
"""Minimum change of the voltage as a fraction of the ohmic drop across R_s of the cell file. R_s of a power cell may be a third
of the generic one."""
MAX_WAITING = 2
"""Maximum number of doubtful samples near one level that wait. The next one confirms them, even if the voltage still does not
follow, because a level that persists is a load."""
RC_HIDING_S = 60.0
"""Step from which the RC pairs may hide a change of the current completely [s]. In a shorter step they hide a part."""
NEAR_FRACTION = 0.5
"""Maximum difference of a current that confirms a doubtful one, as a fraction of the doubtful change."""
UINT16_VALUES = 65536.0
"""Number of values of an integer of 16 bits."""
STEPS_A = (1.0, 0.1, 0.01, 0.001)
"""Usual resolutions of a current in protocols [A]."""
MAX_WRAPPED_FRACTION = 0.05
"""Maximum charge current that counts as small, as a fraction of the range of the integer."""
_HELD = int(SampleStatus.VOLTAGE_HELD | SampleStatus.CURRENT_HELD)

CURRENT_CHECK = np.dtype(
    [
        ("reference_v", "f8"),  # voltage of the last accepted sample with measured voltage and current [V]
        ("reference_a", "f8"),  # current of that sample [A]
        ("waiting", "i8"),  # number of doubtful samples that wait
        ("seen_s", "f8"),  # time from the last accepted sample to the last doubtful or rejected one [s]; 0: none
        ("age_s", "f8"),  # time from the last accepted sample to the first doubtful one [s]
        ("current_a", "f8"),  # current of the first doubtful sample [A]
        ("voltage_v", "f8"),  # voltage of the first doubtful sample [V]
    ],
    align=True,
)
"""State of the check."""


@njit(cache=True)
def max_step(o: Record, p: Record) -> float:
    """Return the maximum duration of a step without a gap [s]. ``o`` is a record of OBSERVER_STATE."""
    return max(p.gap_s, GAP_RATIO * o.step_s)


@njit(cache=True)
def is_doubtful(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float, status: int) -> bool:
    """Return True if a sample waits for the next one, or is rejected.

    Args:
        s: Record of ESTIMATOR_STATE; updated if the result is True.
        p: Record of OBSERVER_SETTINGS.
        dt_s: Time since the last accepted sample [s].
        current_a: Current [A].
        voltage_v: Voltage [V].
        status: Bits of ``SampleStatus``.
    """
    d, o = s.current_check, s.observer
    if not o.started or status & _HELD or s.checks.suspects & UNUSABLE:
        return False
    if not dt_s > 0.0 or dt_s - d.seen_s > max_step(o, p):  # another time base, or a gap
        return False
    if voltage_follows(d, p, dt_s, current_a, voltage_v):
        return False
    if is_wrapped(current_a):
        d.seen_s = dt_s
        count_rejected(s, 1)
        return True
    if d.waiting > 0 and not is_near(d, current_a):
        reject_waiting(s)
    if d.waiting == MAX_WAITING:
        return False
    if d.waiting == 0:
        d.age_s, d.current_a, d.voltage_v = dt_s, current_a, voltage_v
    d.seen_s = dt_s
    d.waiting += 1
    return True


@njit(cache=True)
def set_reference(d: Record, current_a: float, voltage_v: float, status: int) -> None:
    """Store an accepted sample with measured voltage and current as the reference of later changes."""
    if not status & _HELD:
        d.reference_a, d.reference_v = current_a, voltage_v


@njit(cache=True)
def voltage_follows(d: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> bool:
    """Return True if the voltage follows the change to ``current_a``, or if the change may be invisible.

    The RC pairs still follow the reference current, and may hide a change of the opposite direction.
    """
    drop_v = p.check_ohm * abs(current_a - d.reference_a)
    hidden_v = p.check_slow_ohm * abs(d.reference_a) * min(1.0, dt_s / RC_HIDING_S)
    return drop_v <= p.check_v + hidden_v or abs(voltage_v - d.reference_v) >= FOLLOWED_FRACTION * drop_v


@njit(cache=True)
def is_near(d: Record, current_a: float) -> bool:
    """Return True if a current is near the doubtful level."""
    return abs(current_a - d.current_a) <= NEAR_FRACTION * abs(d.current_a - d.reference_a)


@njit(cache=True)
def is_wrapped(current_a: float) -> bool:
    """Return True if a current may be a small negative number of 16 bits that was read as an unsigned one."""
    wrapped = False
    for step_a in STEPS_A:
        wrapped |= 0.0 <= UINT16_VALUES * step_a - abs(current_a) <= MAX_WRAPPED_FRACTION * UINT16_VALUES * step_a
    return wrapped


@njit(cache=True)
def count_rejected(s: Record, samples: int) -> None:
    """Count rejected samples."""
    s.observer.dropped_contradicted += samples
    s.checks.outliers += samples


@njit(cache=True)
def reject_waiting(s: Record) -> None:
    """Reject the samples that wait, and count them."""
    count_rejected(s, s.current_check.waiting)
    s.current_check.waiting = 0


@njit(cache=True)
def accept_waiting(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> bool:
    """Accept or reject the samples that wait, when a later sample is accepted. Return True if it confirms them.

    The parameters are those of ``is_doubtful``.
    """
    d = s.current_check
    d.seen_s = 0.0
    if d.waiting == 0:
        return False
    late_s = dt_s - d.age_s
    is_late = late_s <= max_step(s.observer, p) and voltage_follows(d, p, d.age_s, d.current_a, voltage_v)
    if late_s > 0.0 and (is_near(d, current_a) or is_late):
        s.observer.samples += d.waiting
        d.waiting = 0
        return True
    reject_waiting(s)
    return False
