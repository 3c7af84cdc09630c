"""Observed load as arrays, which are saved in a file beside the checkpoint."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.forecast.past_minutes import MAX_MINUTES, PastMinutes
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S

MAX_CURRENT_A = 1e6
"""Maximum plausible absolute current [A]."""
MAX_REST_S = 1e10
"""Maximum plausible duration of a rest [s]: 300 years."""

SCALARS = "filtered_a", "last_a", "rest_s", "seen_discharge_a", "seen_charge_a"
"""Saved fields of ``LOAD`` that are numbers."""


def load_arrays(load: LoadHistory, past: PastMinutes) -> dict[str, NDArray[Any]]:
    """Return the load as arrays by name, for ``restore_load``."""
    row = load.record[0]
    mean_a, max_a = load.mean_and_max()
    return {
        "mean_a": mean_a.astype(np.float32),
        "max_a": max_a.astype(np.float32),
        **{name: np.array(row[name]) for name in SCALARS},
        "minutes_mean_a": past.mean_a.astype(np.float32),
        "minutes_max_a": past.max_a.astype(np.float32),
    }


def restore_load(load: LoadHistory, past: PastMinutes, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Restore a load.

    Arrays without the largest currents so far, as the version before saved them, leave them 0.

    Args:
        load: Empty load to fill; unchanged if the arrays are invalid.
        past: Empty minutes to fill; unchanged if the arrays are invalid.
        arrays: Arrays of ``load_arrays``.

    Raises:
        ValueError: An array is missing, or has another shape or implausible values.
    """
    arrays = {"seen_discharge_a": np.array(0.0), "seen_charge_a": np.array(0.0), **arrays}
    missing = [name for name in load_arrays(load, past) if name not in arrays]
    if missing:
        raise ValueError(f"{', '.join(missing)}: missing")
    mean_a, max_a, scalars = arrays["mean_a"], arrays["max_a"], [arrays[name] for name in SCALARS]
    minutes_mean_a, minutes_max_a = arrays["minutes_mean_a"], arrays["minutes_max_a"]
    for mean, largest, max_size in ((mean_a, max_a, MAX_LOAD_S), (minutes_mean_a, minutes_max_a, MAX_MINUTES)):
        if mean.ndim != 1 or mean.shape != largest.shape or mean.size > max_size or any(v.ndim for v in scalars):
            raise ValueError(
                f"arrays of shapes {mean.shape} and {largest.shape}: must be equal, with at most {max_size} elements"
            )
    for values in (mean_a, max_a, minutes_mean_a, minutes_max_a, *scalars):
        limit = MAX_REST_S if values is arrays["rest_s"] else MAX_CURRENT_A
        if values.dtype.kind not in "fi" or not (np.abs(values) <= limit).all():
            raise ValueError("a value is not finite, or too large")
    if arrays["rest_s"] < 0:
        raise ValueError("the duration of the rest is negative")
    row = load.record[0]
    for name in SCALARS:
        row[name] = arrays[name]
    row["count"], row["next"] = mean_a.size, mean_a.size % MAX_LOAD_S
    row["mean_a"][: mean_a.size], row["max_a"][: mean_a.size] = mean_a, np.maximum(mean_a, max_a)
    past.restore(minutes_mean_a.astype(float), np.maximum(minutes_mean_a, minutes_max_a).astype(float), load)
