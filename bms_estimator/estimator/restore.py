"""Restoration of an estimator from the fields of a checkpoint."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import OBSERVER_COUNTERS, Estimator
from bms_estimator.kernels.accumulators.history import HISTORY_ROW, MAX_ROWS
from bms_estimator.kernels.kalman_filter.element_map import ELEMENTS
from bms_estimator.kernels.kalman_filter.input_checks import COUNTERS
from bms_estimator.kernels.kalman_filter.mixture import scale_state
from bms_estimator.kernels.kalman_filter.noise import offset_variance
from bms_estimator.kernels.kalman_filter.records import HYPOTHESES, LN_Q, OFFSET
from bms_estimator.model.arrays import SAMPLE, fields

MAX_TIME_S = 1e11
"""Maximum plausible time since the history began [s], 3,000 years."""
MAX_SEGMENT = 1e9
"""Maximum plausible number of a segment. Each restart and each gap begin one."""
MAX_CHARGE_AS = 1e12
"""Maximum plausible absolute charge counter [A s]."""
MAX_VOLTAGE_V, MAX_CURRENT_A, MAX_TEMPERATURE_C = 1e5, 1e6, 1e3
"""Maximum plausible absolute values of a pack's voltage [V], current [A] and temperature [degC]."""
_FILTER_SOC = (-0.1, 1.1)
"""Plausible range of an SOC of the filter, which limits it to -0.05..1.05."""
ROUNDING_S = 1.0
"""Maximum decrease of the time between two rows due to the rounding of merged rows [s]."""
TIME, SEGMENT, CHARGE = (0.0, MAX_TIME_S), (0.0, MAX_SEGMENT), (-MAX_CHARGE_AS, MAX_CHARGE_AS)
"""Plausible ranges of times, numbers of segments and charges."""
_CURRENT, _VARIANCE = (-MAX_CURRENT_A, MAX_CURRENT_A), (0.0, MAX_CURRENT_A**2)
_ROW_RANGES = {
    "elapsed_s": TIME,
    "duration_s": TIME,
    "segment": SEGMENT,
    "direction": (-1.0, 1.0),
    "voltage_v": (-MAX_VOLTAGE_V, MAX_VOLTAGE_V),
    "current_a": _CURRENT,
    "between_a2": _VARIANCE,
    "skew_a2": _VARIANCE,
    "x_a": _CURRENT,
    "settled_s": TIME,
    "temperature_c": (-MAX_TEMPERATURE_C, MAX_TEMPERATURE_C),
    "charge_as": CHARGE,
    "charge_variance_as2": (0.0, MAX_CHARGE_AS**2),
    "throughput_soc": (0.0, MAX_CHARGE_AS),
    "hysteresis": (-1.001, 1.001),  # a mean of values of -1 may be rounded
    "soc": _FILTER_SOC,
    "reference_kind": (0.0, 2.0),
}
"""Range of each field of a row that is always finite."""


def checked_rows(rows: NDArray[Any] | None) -> NDArray[np.void]:
    """Return saved rows after a check.

    Raises:
        ValueError: They have another layout, an implausible value, or are not in the order of time.
    """
    if rows is None or rows.dtype != HISTORY_ROW or rows.ndim != 1:
        raise ValueError("its rows have another layout")
    for name, limits in _ROW_RANGES.items():
        if not is_within(rows[name], limits):
            raise ValueError(f"{name} of a row is damaged")
    for name in ("segment", "direction", "reference_kind"):
        if (rows[name] % 1.0).any():
            raise ValueError(f"{name} of a row is damaged")
    soc, std = rows["reference_soc"], rows["reference_std"]
    known = ~np.isnan(soc)
    if not (is_within(soc[known], _FILTER_SOC) and ((std[known] > 0.0) & (std[known] <= 1.0)).all()):
        raise ValueError("a known SOC of a row is damaged")
    if not (rows["gap_s"] >= 0.0).all():
        raise ValueError("gap_s of a row is damaged")
    if (np.diff(rows["segment"]) < 0.0).any() or (np.diff(rows["elapsed_s"]) < -ROUNDING_S).any():
        raise ValueError("its rows are not in the order of time")
    return rows


def is_within(values: NDArray[Any], limits: tuple[float, float]) -> bool:
    """Return True if no value is NaN or outside the limits."""
    return bool(((values >= limits[0]) & (values <= limits[1])).all())


_PARTS_WITHOUT_FILTER = ("observer.", "learning.", "series_resistance.")
"""Prefixes of the fields that are also estimated while the filter is off."""
_FINITE_PARTS = ("observer", "learning", "series_resistance", "filter", "checks", "anchors", "map")
"""Parts that are refused with a value that is not finite."""
MAX_COUNT = 1e15
"""Maximum plausible absolute value of a counter: the number of samples of 30,000 years at 1,000 a second."""
MAX_SUM = 1e24
"""Maximum plausible absolute value of a sum over a row of the history, the square of the maximum charge [A^2 s^2]."""
MAX_SOC_DIFFERENCE = 0.03
"""Maximum difference between the SOC of filter and observer. A larger difference shows that the filter was switched
off for some time, so that its state is outdated."""


def restore_state(estimator: Estimator, saved: Mapping[str, NDArray[Any]], unseen_s: float) -> str:
    """Restore a new estimator from a checkpoint's state, with counters that start from zero.

    Fields that the checkpoint lacks, or has in another shape, are initialized as by a first sample. Additional fields of the
    checkpoint are ignored.

    Args:
        estimator: New estimator; unchanged if the state is invalid.
        saved: Fields of the checkpoint by their names.
        unseen_s: Length of the unmeasured gap [s]; infinite if unknown.

    Returns:
        Reason for which the state is invalid; empty if the estimator was restored.
    """
    record_before = estimator.record.copy()
    try:
        reason = _restore(estimator, saved, unseen_s)
    except Exception as error:  # noqa: BLE001 - an odd value of the file must not end the service at each start
        reason = f"damaged ({type(error).__name__})"
    if reason:
        estimator.record[...] = record_before
    return reason


def _restore(estimator: Estimator, saved: Mapping[str, NDArray[Any]], unseen_s: float) -> str:
    """Restore an estimator as ``restore_state`` does. An invalid state may leave the estimator partly changed."""
    sample = np.zeros(1, SAMPLE)
    sample["voltage_v"], sample["temperature_c"] = estimator.cell.cell.nominal_voltage_v, np.nan
    estimator.run(sample)  # the kernels of a block are compiled before the first sample, those of `step` are not
    after_first_sample = estimator.record.copy()
    filter_was_on = bool(saved.get("filter.started", np.zeros(1))[0])
    # a filter that was off has not initialized its fields
    restored = {name: v for name, v in saved.items() if filter_was_on or name.startswith(_PARTS_WITHOUT_FILTER)}
    copy_known_fields(estimator.record, restored)
    reason = _invalid_state_reason(estimator, after_first_sample)
    if reason:
        return reason
    f = estimator.record["filter"]
    soc_difference = abs(f["soc"][0] - estimator.state["soc"][0])
    if estimator.has_filter and (not filter_was_on or soc_difference > MAX_SOC_DIFFERENCE):
        unseen_s = math.inf  # the filter's state is outdated: resume as after a gap of unknown length
    _reset_switched_states(estimator)
    estimator.resume(unseen_s)
    for name in OBSERVER_COUNTERS:
        estimator.state[name] = 0
    estimator.record["counters"] = np.zeros(1, COUNTERS)
    estimator.record["filter"]["reopened"] = estimator.record["checks"]["seen_reopened"] = 0
    estimator.record["history"]["enabled"] = 0  # the slow fit, which takes the rows, enables them again
    estimator.record["anchors"]["full_anchors"] = estimator.record["anchors"]["empty_anchors"] = 0
    return ""


def copy_known_fields(record: NDArray[np.void], saved: Mapping[str, NDArray[Any]]) -> None:
    """Copy saved fields to the fields of ``record`` with equal names and shapes."""
    for name, field in fields(record):
        value = saved.get(name)
        if value is not None and value.shape == field.shape and np.can_cast(value.dtype, field.dtype, "same_kind"):
            field[...] = value


def _reset_switched_states(estimator: Estimator) -> None:
    """Reset current offset or capacity to its prior if a changed setting has enabled or disabled its estimation."""
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    best = f["best"]
    for j, variance in ((OFFSET, offset_variance(p)), (LN_Q, p["capacity_std"] ** 2)):
        if (f["covariance"][best, j, j] > 0.0) != (variance > 0.0):
            scale_state(f["mean"][best], f["covariance"][best], j, 0.0)
            f["covariance"][best, j, j] = variance


def _invalid_state_reason(estimator: Estimator, after_first_sample: NDArray[np.void]) -> str:
    """Return the reason for which a state is invalid; empty if it is valid.

    Values that are not finite after a first sample are not checked.
    """
    record, cell = estimator.record, estimator.cell.cell
    for (name, field), (_, first_field) in zip(fields(record), fields(after_first_sample), strict=True):
        part, _, quantity = name.partition(".")
        if part in _FINITE_PARTS and not np.isfinite(field[np.isfinite(first_field)]).all():
            return f"{quantity} of the {part} is not finite"
    s, first = record[0]["observer"], after_first_sample[0]["observer"]
    if not s["started"]:
        return "it contains no sample"
    ranges = {
        "soc": (0.0, 1.0),
        "v_ts": (-cell.voltage_max_v, cell.voltage_max_v),  # voltages of the fast and the slow RC pair
        "v_tl": (-cell.voltage_max_v, cell.voltage_max_v),
        "k": (0.0, np.inf),  # adaptive gain
    }
    for name, (low, high) in ranges.items():
        if not low <= s[name] <= high and np.isfinite(first[name]):
            return f"{name} = {s[name]} is outside {low}..{high}"
    is_used = first["a"] > 0.0  # unused elements of the array are zero after a first sample
    if not (s["a"][is_used] > 0.0).all():
        return "a parameter a1..a15 is not positive"
    return _invalid_counter_reason(record) or (
        _invalid_filter_reason(record[0]["filter"]) if estimator.has_filter else ""
    )


def _invalid_counter_reason(record: NDArray[np.void]) -> str:
    """Return the reason for which a counter, an index or the recorded history is invalid; empty if all are valid.

    Kernels do not check that an index is within its array.
    """
    h = record[0]["history"]
    integers = np.concatenate([field.ravel() for _, field in fields(record) if field.dtype.kind == "i"])
    is_plausible = (np.abs(integers.astype(float)) <= MAX_COUNT).all()
    if not (is_plausible and 0 <= record[0]["next_element"] < ELEMENTS and 0 <= h["count"] <= MAX_ROWS):
        return "a counter or an index is implausible"
    return "" if _has_valid_history(h) else "the last rows of the history are damaged"


def _has_valid_history(h: np.void) -> bool:
    """Return True if the rows that wait for the slow fit are valid, and the present row can be completed."""
    try:
        checked_rows(h["rows"][: int(h["count"])])
    except ValueError:
        return False
    sums = np.concatenate([np.ravel(h["sums"][name]) for name in HISTORY_ROW.names or ()])
    counters = np.array(
        [h[name] for name in ("elapsed_s", "charge_as", "charge_variance_as2", "throughput_soc", "row_as")]
    )
    is_finite = (np.abs(sums) <= MAX_SUM).all() and (np.abs(counters) <= MAX_SUM).all()
    return bool(is_finite and 0 <= h["segment"] <= MAX_SEGMENT and h["gap_s"] >= 0.0 and h["event_s"] >= 0.0)


def _invalid_filter_reason(f: np.void) -> str:
    """Return the reason for which the filter's state is invalid; empty if it is valid."""
    count, best = int(f["count"]), int(f["best"])
    if not 0 <= best < count <= HYPOTHESES:
        return f"{count} hypotheses, the best of them {best}"
    variances = np.diagonal(f["covariance"][:count], axis1=1, axis2=2)
    return "" if (variances >= 0.0).all() else "a variance is negative"
