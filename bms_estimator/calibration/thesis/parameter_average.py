"""Average of the parameters over the settled part of a run, (3.19) of the thesis.

The average begins at the time t_int, when the error has settled, and ends at the time t_unst, when the battery becomes
unstable. Both times are determined from the run. delta1 (2.11) and delta2 (2.12) are the SOCs below which C_ts and C_tl
of the model are negative.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError

SETTLED_SHARE = 0.99
"""Minimum fraction of the samples after t_int whose error is within its bound."""
SETTLED_PARAMETER = 1e-3
"""Maximum relative deviation of a settled parameter from its median."""
SLOPE_WINDOWS = 100
"""Number of windows of a run over which the slope of the voltage is computed."""
KNEE_SLOPE = 5.0
"""Slope of the voltage after its knee, in multiples of the median slope of the run."""


@dataclass(frozen=True)
class AveragingWindow:
    """Interval over which (3.19) averages, and its reasons.

    Attributes:
        t_int_s: Time from which the error stays small [s].
        t_unst_s: Time at which the battery becomes unstable [s].
        start_reason: Criterion that determined t_int.
        end_reason: Criterion that determined t_unst.
    """

    t_int_s: float
    t_unst_s: float
    start_reason: str
    end_reason: str


def averaging_window(
    time_s: Floats,
    error_v: Floats,
    voltage_v: Floats,
    margin: Floats,
    a: Floats,
    epsilon_v: float,
    *,
    t_int_s: float | None = None,
    t_unst_s: float | None = None,
) -> AveragingWindow:
    """Find t_int and t_unst of (3.19).

    t_unst is the time at which ``margin`` reaches zero or the voltage reaches its knee, whichever is first. From t_int
    to t_unst, 99 % of the errors are within ``epsilon_v`` and each parameter a_i is within 0.1 % of its median. An
    average from the first sample on would contain the transient from the initial value of a_i.

    Args:
        time_s: Shape (n,) [s].
        error_v: Tracking error e (3.15) [V].
        voltage_v: Measured voltage y [V].
        margin: SOC - max(delta1, delta2), less the observer's setting ``margin_guard``.
        a: Shape (n, 16), a1..a15 at index 1..15.
        epsilon_v: Maximum error of a settled observer [V].
        t_int_s: t_int given by the user [s]; None: determined from the run.
        t_unst_s: t_unst given by the user [s]; None: determined from the run.

    Raises:
        UserError: A given time lies outside the run, or t_int after t_unst.
    """
    if t_unst_s is not None:
        _check_inside("t_unst", t_unst_s, time_s[0], time_s[-1])
    end_s, end_reason = _unstable_from(time_s, voltage_v, margin) if t_unst_s is None else (t_unst_s, "given")
    if t_int_s is not None:
        _check_inside("t_int", t_int_s, time_s[0], end_s)
        return AveragingWindow(t_int_s, end_s, "given", end_reason)
    inside = time_s <= end_s
    large = np.abs(error_v[inside]) > epsilon_v
    remaining = np.arange(large.size, 0, -1)
    large_fraction = (
        np.cumsum(large[::-1])[::-1] / remaining
    )  # fraction of large errors in each sample and its successors
    settled = (large_fraction <= 1.0 - SETTLED_SHARE) & ~large
    if not settled.any():
        # the window contains only its last sample, and ``averaged`` returns the values of that sample
        reason = f"the error never settles within {1e3 * epsilon_v:.2f} mV"
        return AveragingWindow(float(time_s[inside][-1]), end_s, reason, end_reason)
    error_from = int(np.argmax(settled))
    a_from = _settled_from(a[inside])
    if a_from > error_from:
        reason = f"every later a_i is within {100 * SETTLED_PARAMETER:g} % of its median"
        return AveragingWindow(float(time_s[inside][a_from]), end_s, reason, end_reason)
    reason = f"99 % of the later errors are within {1e3 * epsilon_v:.2f} mV"
    return AveragingWindow(float(time_s[inside][error_from]), end_s, reason, end_reason)


def _check_inside(name: str, given_s: float, first_s: float, last_s: float) -> None:
    """Check that a given time lies within the run."""
    if not first_s <= given_s <= last_s:
        raise UserError(f"{name} = {given_s:g} s: must lie within {first_s:g} to {last_s:g} s of the run")


def _settled_from(a: Floats) -> int:
    """Return the index from which on every parameter stays near its median over the second half."""
    median = np.median(a[a.shape[0] // 2 :], axis=0)
    unsettled = np.flatnonzero((np.abs(a - median) > SETTLED_PARAMETER * np.abs(median)).any(axis=1))
    return min(int(unsettled[-1]) + 1, a.shape[0] - 1) if unsettled.size else 0


def _unstable_from(time_s: Floats, voltage_v: Floats, margin: Floats) -> tuple[float, str]:
    """Return the time at which the battery becomes unstable [s], and the reason."""
    candidates = [(float(time_s[-1]), "end of the run")]
    if (margin <= 0.0).any():
        candidates.append((float(time_s[int(np.argmax(margin <= 0.0))]), "SOC reached max(delta1, delta2)"))
    knee_s = _knee(time_s, voltage_v)
    if knee_s is not None:
        candidates.append((knee_s, "knee of the voltage"))
    return min(candidates, key=lambda candidate: candidate[0])


def _knee(time_s: Floats, voltage_v: Floats) -> float | None:
    """Return the time at which the last fall of the voltage begins [s]; None without one."""
    edges = np.linspace(0, time_s.size - 1, SLOPE_WINDOWS + 1).astype(int)
    if np.unique(edges).size < edges.size:  # fewer samples than windows
        return None
    fall_v_per_s = -np.diff(voltage_v[edges]) / np.diff(time_s[edges])
    median_v_per_s = float(np.median(fall_v_per_s))
    steep = fall_v_per_s > KNEE_SLOPE * median_v_per_s
    if median_v_per_s <= 0.0 or not steep[-1]:
        return None
    gentle = np.flatnonzero(~steep)
    first = int(gentle[-1]) + 1 if gentle.size else 0
    return float(time_s[edges[first]])


def averaged(time_s: Floats, a: Floats, window: AveragingWindow) -> Floats:
    """Return the mean of a_i(t) over t_int..t_unst, (3.19).

    Args:
        time_s: Shape (n,), increasing, in steps of any length [s].
        a: Shape (n, 16), a1..a15 at index 1..15.
        window: t_int and t_unst.

    Returns:
        Shape (16,). If fewer than two samples lie between t_int and t_unst, the values of the last sample.
    """
    inside = (time_s >= window.t_int_s) & (time_s <= window.t_unst_s)
    if inside.sum() < 2:
        return np.asarray(a[inside][-1] if inside.any() else a[-1], dtype=np.float64)
    elapsed, values = time_s[inside], a[inside]
    area = np.trapezoid(values, elapsed, axis=0)
    return np.asarray(area / (elapsed[-1] - elapsed[0]), dtype=np.float64)  # (3.19)
