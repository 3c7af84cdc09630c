"""Check of saved rows of a history. A file may contain any values, and an implausible one would end the service at each start."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HISTORY_ROW

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
