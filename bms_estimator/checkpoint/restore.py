"""Restore of an estimator from a checkpoint's fields."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import fields
from bms_estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.input_checks import COUNTERS, store_last_good_state
from bms_estimator.kernels.kalman_filter.mixture import decorrelate_state
from bms_estimator.kernels.kalman_filter.noise import offset_variance
from bms_estimator.kernels.kalman_filter.ocv_correction import reset_ocv_correction
from bms_estimator.kernels.kalman_filter.records import HYPOTHESES, LN_Q, OFFSET, STATES
from bms_estimator.kernels.observer.records import OBSERVER_STATE

_DROPPED = tuple(name for name in OBSERVER_STATE.names or () if name.startswith("dropped_"))
OBSERVER_COUNTERS = ("samples", "gaps", "time_steps_back", "lock_losses", "gain_rearms", *_DROPPED)
"""Fields of the observer's state that count since start."""
EXTENDABLE_FIELDS = {"filter.mean": 1, "filter.covariance": 2}
"""Number of last axes of a field that run along the filter's states; a version appends new states at the end."""
SAME_SOC = 0.03
"""Largest difference between the SOC of filter and observer; beyond it the filter was switched off."""


def restore_state(estimator: Estimator, saved: Mapping[str, NDArray[Any]], unseen_s: float) -> str:
    """Go on from a checkpoint's state, saved ``unseen_s`` ago, on the board's new clock. The counters count from this start.

    A field that the checkpoint does not have, or has in another shape, is what a first sample makes it, and so are states
    that the filter has more; a field that only the checkpoint has is left.

    Args:
        estimator: A new one; as it was when the state cannot be used.
        saved: Fields by their names.
        unseen_s: Length of the unmeasured gap [s]; infinite if unknown.

    Returns:
        Why the state cannot be used; empty when it is.
    """
    new = estimator.record.copy()
    estimator.step(0.0, 0.0, estimator.cell.cell.nominal_voltage_v)
    begun = estimator.record.copy()
    was_on = bool(saved.get("filter.started", np.zeros(1))[0])
    copy_known_fields(
        estimator.record,
        {
            name: v
            for name, v in saved.items()
            if was_on or name.startswith(("observer.", "learning.", "series_resistance."))
        },
    )
    wrong = _invalid_state_reason(estimator, begun)
    if wrong:
        estimator.record[...] = new
        return wrong
    f = estimator.record["filter"]
    if estimator.identifying and (not was_on or abs(f["soc"][0] - estimator.state["soc"][0]) > SAME_SOC):
        unseen_s = math.inf
    if "filter.mean_a" not in saved:  # a version without the load statistics
        f["mean_a"] = f["current_a"]
    if was_on and saved.get("filter.mean", np.zeros(0)).shape[-1] < STATES:
        _open_curve(estimator)
    _open_new_states(estimator)
    estimator.resume(unseen_s)
    for name in OBSERVER_COUNTERS:
        estimator.state[name] = 0
    estimator.record["counters"] = np.zeros(1, COUNTERS)
    estimator.record["filter"]["reopened"] = estimator.record["checks"]["seen_reopened"] = 0
    return ""


def copy_known_fields(record: NDArray[np.void], saved: Mapping[str, NDArray[Any]]) -> None:
    """Take from ``saved``, fields by their names, what ``record`` has in the same shape, or in one that has grown."""
    for name, field in fields(record):
        known = saved.get(name)
        if known is None or known.ndim != field.ndim:
            continue
        if known.shape == field.shape:
            field[...] = known
        elif name in EXTENDABLE_FIELDS and _is_shorter(known.shape, field.shape, EXTENDABLE_FIELDS[name]):
            field[tuple(map(slice, known.shape))] = known


def _is_shorter(known: tuple[int, ...], field: tuple[int, ...], axes: int) -> bool:
    """Return True if the shapes differ only in the last ``axes``, along which the saved array is shorter."""
    return known[:-axes] == field[:-axes] and max(known[-axes:]) <= field[-1]


def _open_curve(estimator: Estimator) -> None:
    """Reset the error of the OCV if an earlier version did not have it as a state."""
    f, c = estimator.record[0]["filter"], estimator.record[0]["checks"]
    count = int(f["count"])
    for mean, covariance in zip(f["mean"][:count], f["covariance"][:count], strict=True):
        reset_ocv_correction(mean, covariance)
    store_last_good_state(c, f)


def _open_new_states(estimator: Estimator) -> None:
    """Offset and capacity start as configured if they were not states of the filter before, or are not now."""
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    best = f["best"]
    for j, variance in ((OFFSET, offset_variance(p)), (LN_Q, p["capacity_std"] ** 2)):
        if (f["covariance"][best, j, j] > 0.0) != (variance > 0.0):
            decorrelate_state(f["mean"][best], f["covariance"][best], j)
            f["covariance"][best, j, j] = variance


def _invalid_state_reason(estimator: Estimator, begun: NDArray[np.void]) -> str:
    """Why a state cannot be used; empty when it can. What a first sample leaves without a value, ``begun``, needs none."""
    record, cell = estimator.record, estimator.cell.cell
    for (name, field), (_, first) in zip(fields(record), fields(begun), strict=True):
        part, _, what = name.partition(".")
        known = np.isfinite(first)
        if (
            part in ("observer", "learning", "series_resistance", "filter", "checks", "map")
            and not np.isfinite(field[known]).all()
        ):
            return f"{what} of the {part} is not finite"
    s = record[0]["observer"]
    if not s["started"]:
        return "no sample was taken"
    ranges = {
        "soc": (0.0, 1.0),
        "v_ts": (-cell.voltage_max_v, cell.voltage_max_v),
        "v_tl": (-cell.voltage_max_v, cell.voltage_max_v),
        "k": (0.0, np.inf),
    }
    for name, (low, high) in ranges.items():
        if not low <= s[name] <= high and np.isfinite(begun[0]["observer"][name]):
            return f"{name} = {s[name]} is outside {low}..{high}"
    if not (s["a"][begun[0]["observer"]["a"] > 0.0] > 0.0).all():
        return "a parameter a1..a15 is not positive"
    return _insane_filter(record[0]["filter"]) if estimator.identifying else ""


def _insane_filter(f: np.void) -> str:
    """Return why the filter's state is invalid; empty if it is valid."""
    count, best = int(f["count"]), int(f["best"])
    if not 0 <= best < count <= HYPOTHESES:
        return f"{count} hypotheses, the best of them {best}"
    variances = np.diagonal(f["covariance"][:count], axis1=1, axis2=2)
    return "" if (variances >= 0.0).all() else "a variance is not positive"
