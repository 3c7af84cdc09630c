"""Step 2 of the thesis: run of the adaptive observer over a capture, and the average of its parameters.

Numbers in parentheses are equations of the thesis. Errata are listed in docs/theory/thesis.md. a1..a15 are the coefficients of
the elements of Chen and Mora's model as functions of SOC. The observer runs over the whole capture by Algorithm 1 or one of
schemes 1 to 3. It stops adapting at the SOC below which a capacitance of the model is negative (Fig. 19). The result contains
"converged" or the reason for a failure.

The average (3.19) begins at the time t_int, when the error has settled, and ends at the time t_unst, when the model becomes
unstable. Both times are determined from the run. delta1 (2.11) and delta2 (2.12) are the SOCs below which C_ts and C_tl
of the model are negative.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS, delta
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.errors import UserError

SETTLED_FRACTION = 0.99
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
    # fraction of large errors in each sample and its successors
    large_fraction = np.cumsum(large[::-1])[::-1] / remaining
    settled = (large_fraction <= 1.0 - SETTLED_FRACTION) & ~large
    if not settled.any():
        # the window contains only its last sample, and ``average_parameters`` returns the values of that sample
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
    """Return the index after which every parameter stays near its median over the second half."""
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
    """Return the time at which the last fall of the voltage begins [s]; None without a fall."""
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


def average_parameters(time_s: Floats, a: Floats, window: AveragingWindow) -> Floats:
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


SNAPSHOTS = 3000
"""Maximum number of equidistant snapshots of a_i(t) over a run, in addition to ``FIRST_SAMPLES``."""
FIRST_SAMPLES = 200
"""Number of first samples that are all recorded, because a_i(t) moves from its initial value to its limit there."""
CONVERGED_FRACTION = 0.95
"""Minimum fraction of the samples between t_int and t_unst whose error is within eps2."""

SNAPSHOT_FIELDS = (
    "time_s",
    "soc",
    "current_a",
    "voltage_v",
    "voltage_estimate_v",
    "k",
    "nussbaum_gain",
    "delta_1",
    "delta_2",
)
"""Fields of the trace that each snapshot contains."""


@dataclass(frozen=True)
class Crossing:
    """Point at which a stability condition of Lemma 4.1.1 ceases to hold: a dashed line of Fig. 19.

    Attributes:
        parameter: "a8" for C_ts, "a11" for C_tl.
        soc: delta1 (delta2), the SOC below which C_ts (C_tl) is negative, of the parameters at the end of adaptation.
        time_s: Time at which SOC reached ``soc`` [s]; None if the capture ends above ``soc``.
    """

    parameter: str
    soc: float
    time_s: float | None


@dataclass(frozen=True)
class AdaptiveRun:
    """Run of the observer over a capture. Arrays over time have shape (n,), where n is the number of snapshots.

    Attributes:
        time_s: Time of the snapshots [s].
        soc: SOC by coulomb counting, 0..1.
        current_a: Current, positive on discharge [A].
        voltage_v: Measured voltage y [V].
        voltage_estimate_v: Estimated voltage y^ of the run, with time-varying parameters [V].
        error_v: Tracking error e (3.15), the largest in magnitude since the previous snapshot [V].
        k: State of the adaptive gain (3.13).
        gain: Nussbaum gain N(k).
        a: Shape (n, 16), a1..a15 at index 1..15.
        window: Interval t_int to t_unst over which (3.19) averages.
        average: Shape (16,), averages (3.19) of a1..a15 at index 1..15.
        crossings: Points of the run at which a8 and a11 meet their stability conditions.
        epsilon_v: eps2 of Algorithm 1, the maximum error of a converged observer [V].
        lock_losses: Number of times that the observer lost the lock.
        outcome: "converged", or the reason for a failure.
    """

    time_s: Floats
    soc: Floats
    current_a: Floats
    voltage_v: Floats
    voltage_estimate_v: Floats
    error_v: Floats
    k: Floats
    gain: Floats
    a: Floats
    window: AveragingWindow
    average: Floats
    crossings: tuple[Crossing, Crossing]
    epsilon_v: float
    lock_losses: int
    outcome: str


def adaptive_run(
    estimator: Estimator, samples: SampleBlock, *, t_int_s: float | None = None, t_unst_s: float | None = None
) -> AdaptiveRun:
    """Run the observer over a capture.

    Args:
        estimator: New estimator, or one whose state the run resumes from.
        samples: Dtype ``SAMPLE``.
        t_int_s: Start of the average (3.19) [s]; None: determined from the run.
        t_unst_s: End of the average (3.19) [s]; None: determined from the run.

    Raises:
        UserError: No sample was accepted, or t_int or t_unst lies outside the run.
    """
    # one snapshot at the end of each block: all first samples, then in geometric and in equal steps
    block_edges = np.unique(
        np.r_[
            np.arange(min(FIRST_SAMPLES, samples.size) + 1),
            np.geomspace(1, samples.size, FIRST_SAMPLES).astype(int),
            np.linspace(0, samples.size, min(SNAPSHOTS, samples.size) + 1).astype(int),
        ]
    )
    snapshots = np.zeros(block_edges.size - 1, dtype=TRACE)
    error_v, parameters = np.zeros(block_edges.size - 1), np.zeros((block_edges.size - 1, PARAMETERS))
    snapshot_count, a = 0, estimator.state["a"][0]
    for first, last in itertools.pairwise(block_edges.tolist()):
        block_trace = estimator.run(samples[first:last])
        if block_trace.size == 0:
            continue
        snapshots[snapshot_count] = block_trace[-1]
        tracking_v = block_trace["tracking_error_v"]
        error_v[snapshot_count] = tracking_v[0 if block_trace.size == 1 else int(np.argmax(np.abs(tracking_v)))]
        parameters[snapshot_count] = a
        snapshot_count += 1
    if snapshot_count == 0:
        raise UserError(f"none of {samples.size} samples is within the cell's limits")
    recorded = {name: snapshots[name][:snapshot_count].copy() for name in SNAPSHOT_FIELDS}
    error, parameters = error_v[:snapshot_count], parameters[:snapshot_count]
    epsilon_v = float(estimator.settings["epsilon_v"][0])
    unstable_soc = np.maximum(recorded["delta_1"], recorded["delta_2"])
    margin = recorded["soc"] - unstable_soc - float(estimator.settings["margin_guard"][0])
    window = averaging_window(
        recorded["time_s"],
        error,
        recorded["voltage_v"],
        margin,
        parameters,
        epsilon_v,
        t_int_s=t_int_s,
        t_unst_s=t_unst_s,
    )
    lock_losses = int(estimator.state["lock_losses"][0])
    return AdaptiveRun(
        time_s=recorded["time_s"],
        soc=recorded["soc"],
        current_a=recorded["current_a"],
        voltage_v=recorded["voltage_v"],
        voltage_estimate_v=recorded["voltage_estimate_v"],
        error_v=error,
        k=recorded["k"],
        gain=recorded["nussbaum_gain"],
        a=parameters,
        window=window,
        average=average_parameters(recorded["time_s"], parameters, window),
        crossings=(
            _crossing("a8", parameters[-1], recorded["soc"], recorded["time_s"]),
            _crossing("a11", parameters[-1], recorded["soc"], recorded["time_s"]),
        ),
        epsilon_v=epsilon_v,
        lock_losses=lock_losses,
        outcome=_outcome(window, recorded["time_s"], error, epsilon_v, lock_losses),
    )


def _crossing(parameter: str, a: Floats, soc: Floats, time_s: Floats) -> Crossing:
    """Return the point of the run at which ``parameter`` meets its stability condition."""
    i = int(parameter[1:])
    crossing_soc = float(delta(a[i], a[i + 1], a[i - 1]))
    below = np.flatnonzero(soc <= crossing_soc)
    return Crossing(parameter, crossing_soc, float(time_s[below[0]]) if below.size else None)


def _outcome(window: AveragingWindow, time_s: Floats, error_v: Floats, epsilon_v: float, lock_losses: int) -> str:
    """Evaluate lines 8 to 14 of Algorithm 1, with |e| in place of e (erratum 10)."""
    inside = (time_s >= window.t_int_s) & (time_s <= window.t_unst_s)
    if inside.sum() < 2:
        worst = float(np.abs(error_v[time_s <= window.t_unst_s]).max(initial=0.0))
        return f"not converged: {window.start_reason}; largest |e| {1e3 * worst:.2f} mV until {window.t_unst_s:.0f} s"
    fraction = float((np.abs(error_v[inside]) <= epsilon_v).mean())
    if fraction < CONVERGED_FRACTION:
        return f"not converged: |e| is within {1e3 * epsilon_v:.2f} mV for {100 * fraction:.1f} % of the samples only"
    if lock_losses:
        return f"not converged: lock was lost {lock_losses} times"
    return "converged"
