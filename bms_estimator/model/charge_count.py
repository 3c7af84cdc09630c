"""Charge by the integral of a sampled current, (2.1) of the thesis."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats
from bms_estimator.model.time_faults import gap_s
from bms_estimator.model.unmeasured_time import MAX_FLOW_S, UNMEASURED_S

MIN_END_FRACTION = 0.01
"""Minimum current before or after a gap that counts as a load, as a fraction of the largest current."""


def step_charges_as(time_s: Floats, current_a: Floats) -> Floats:
    """Return the charge from each sample to the next one [As].

    The current is constant until the next sample. Over a gap it is the smaller of the currents before and after it, or 0 if
    their signs differ, as in the estimator. A gap longer than ``MAX_FLOW_S`` carries no charge, because a recording that was
    interrupted for hours does not show which current flowed.

    Args:
        time_s: Shape (n,) [s]. A step back carries no charge.
        current_a: Shape (n,) [A]; the charge has its sign.

    Returns:
        Shape (n - 1,).
    """
    step_s = np.diff(time_s).clip(min=0.0)
    is_gap = step_s > max(gap_s(step_s), UNMEASURED_S)
    held_a = np.where(is_gap, smaller_current_a(current_a), current_a[:-1])
    return np.asarray(np.where(are_long_gaps(time_s), 0.0, held_a) * step_s)


def charge_ah(time_s: Floats, current_a: Floats) -> Floats:
    """Return the sum of ``step_charges_as`` since the first sample, shape (n,) [Ah]."""
    charge_as: Floats = np.r_[0.0, np.cumsum(step_charges_as(time_s, current_a))]
    return charge_as / 3600.0


def smaller_current_a(current_a: Floats) -> Floats:
    """Return the smaller of each current and the next one, or 0 if their signs differ. Shape (n - 1,) [A]."""
    before_a, after_a = current_a[:-1], current_a[1:]
    smaller_a = np.minimum(np.abs(before_a), np.abs(after_a))
    return np.asarray(np.where(before_a * after_a > 0.0, np.copysign(smaller_a, before_a), 0.0))


def are_long_gaps(time_s: Floats) -> NDArray[np.bool_]:
    """Return which steps between two samples are gaps longer than ``MAX_FLOW_S``. Shape (n - 1,)."""
    step_s = np.diff(time_s)
    return np.asarray(step_s > max(gap_s(step_s), MAX_FLOW_S))


def gap_warnings(time_s: Floats, current_a: Floats) -> list[str]:
    """Return a warning if a current flowed before or after a gap longer than ``MAX_FLOW_S``, whose charge counts as 0."""
    finite = np.isfinite(time_s) & np.isfinite(current_a)
    time_s, current_a = time_s[finite], current_a[finite]
    magnitude_a = np.abs(current_a)
    is_load = magnitude_a > MIN_END_FRACTION * magnitude_a.max(initial=0.0)
    gaps = np.flatnonzero(are_long_gaps(time_s) & (is_load[:-1] | is_load[1:]))
    if not gaps.size:
        return []
    first = int(gaps[0])
    line = (
        f"the current in gaps of more than an hour is unknown and counts as 0 A: {gaps.size} after or before a load, the first of "
        f"{time_s[first + 1] - time_s[first]:.0f} s after {time_s[first]:g} s, with {current_a[first]:g} A before and "
        f"{current_a[first + 1]:g} A after it"
    )
    return [line]
