"""Conversion of history and fit to arrays that can be saved, and back.

A file may contain any values, so that all fields are checked for type, shape and range. An implausible value would otherwise end
the service at each start, or at a later fit.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.restore import CHARGE, SEGMENT, TIME, checked_rows, is_within
from bms_estimator.kernels.pack_voltage import CURVE_NODES, DIRECTION_NODES
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import SOC_GRID
from bms_estimator.pack_model.fit import CURVE, PackFit
from bms_estimator.pack_model.history import MAX_ROWS, History, ReferenceDischarges, WeakCellTime
from bms_estimator.pack_model.unknowns import DIRECTIONS

SAVED_MINIMA = 2
"""Number of a fit's minima that are saved. The next fit starts from two minima (``fit.starts``)."""
_RESULT_COUNT = CURVE.stop
"""Number of results of a fit. The slice ``CURVE`` contains the last ones."""
_SOC_RANGE = (-2.0, 3.0)
"""Plausible range of a fitted SOC, which the fit does not limit."""
MAX_RESULT = 20.0
"""Maximum plausible absolute value of a result of a fit: an SOC, a voltage of one cell [V], or ln of a ratio."""
MAX_COST = 1e15
"""Maximum plausible absolute cost of a fit."""
_RESULT_RANGE = (-MAX_RESULT, MAX_RESULT)
FIT_SHAPES = {
    "elapsed_s": (),
    "segment": (),
    "charge_as": (),
    "mean": (_RESULT_COUNT,),
    "covariance": (_RESULT_COUNT, _RESULT_COUNT),
    "curve_v": (SOC_GRID.size,),
    "ln_r": (SOC_GRID.size, 3),
    "hysteresis": (),
    "cost": (),
    "first_segment": (),
}
"""Fields of a fit, with their shapes, that the filter needs when it adopts the fit (``handover``)."""
_FIT_RANGES = {
    "elapsed_s": TIME,
    "segment": SEGMENT,
    "charge_as": CHARGE,
    "mean": _RESULT_RANGE,
    "covariance": (-(MAX_RESULT**2), MAX_RESULT**2),
    "curve_v": _RESULT_RANGE,
    "ln_r": _RESULT_RANGE,
    "hysteresis": (0.0, math.exp(MAX_RESULT)),
    "cost": (-MAX_COST, MAX_COST),
    "first_segment": SEGMENT,
    "row_elapsed_s": TIME,
    "row_soc": _SOC_RANGE,
    "curves": (-MAX_COST, MAX_COST),
}
"""Range of each saved field of a fit."""
_CURVE_UNKNOWNS = CURVE_NODES + DIRECTIONS * DIRECTION_NODES
"""Number of unknowns of the OCV's error and of the direction-dependent error."""
BANK_PREFIX = "bank_"
"""Prefix of the arrays of ``History.first_discharges``, the first discharges of a bank and the fit after them."""

Arrays = Mapping[str, NDArray[Any]]


def curve_arrays(fit: PackFit | None) -> dict[str, NDArray[Any]]:
    """Return the curves and results of a fit by name; empty without a fit."""
    return {} if fit is None else {name: np.array(getattr(fit, name)) for name in FIT_SHAPES}


def fit_from_arrays(arrays: Arrays) -> PackFit | None:
    """Return the fit of ``curve_arrays``, without the fields from which the next fit starts.

    Raises:
        ValueError: A field is missing, or has another shape or an implausible value.
    """
    if not arrays:
        return None
    values: dict[str, Any] = {}
    for name, shape in FIT_SHAPES.items():
        value = _fit_field(arrays, name)
        if value.shape != shape:
            raise ValueError(f"{name} of the fit is damaged")
        values[name] = value if shape else float(value)
    covariance = values["covariance"]
    if not np.allclose(covariance, covariance.T) or (np.diag(covariance) < 0.0).any():
        raise ValueError("the covariance of the fit is damaged")
    if values["first_segment"] > values["segment"]:
        raise ValueError("the fit begins after its last segment")
    empty = np.zeros(0)
    return PackFit(**values, row_elapsed_s=empty, row_soc=empty, curves=())


def _fit_field(arrays: Arrays, name: str) -> Floats:
    """Return a field of a fit.

    Raises:
        ValueError: The field is missing or has an implausible value.
    """
    value = arrays.get(name)
    if value is None or value.dtype.kind not in "fiu" or not is_within(value, _FIT_RANGES[name]):
        raise ValueError(f"{name} of the fit is missing or damaged")
    return value.astype(float)


def neutral_fit() -> PackFit:
    """Return a fit that corrects nothing. The service adopts it before the first sample to compile the code."""
    values: dict[str, Any] = {name: np.zeros(shape) if shape else 0.0 for name, shape in FIT_SHAPES.items()}
    values |= {"covariance": np.eye(_RESULT_COUNT), "hysteresis": 1.0}
    empty = np.zeros(0)
    return PackFit(**values, row_elapsed_s=empty, row_soc=empty, curves=())


def history_arrays(history: History, fit: PackFit | None) -> dict[str, NDArray[Any]]:
    """Return history and fit as arrays by name."""
    weak_cell_times = np.array(history.weak_cell_times).reshape(-1, len(WeakCellTime._fields))
    arrays = {"rows": history.rows, "weak_cell_times": weak_cell_times, **curve_arrays(fit)}
    if history.first_discharges is not None:
        arrays["bank_rows"] = history.first_discharges.rows
        arrays |= {BANK_PREFIX + name: array for name, array in curve_arrays(history.first_discharges.fit).items()}
    if fit is not None:
        arrays |= {"row_elapsed_s": fit.row_elapsed_s, "row_soc": fit.row_soc}
        arrays["curves"] = np.array(fit.curves[:SAVED_MINIMA]).reshape(min(len(fit.curves), SAVED_MINIMA), -1)
    return arrays


def _weak_cell_times(arrays: Arrays) -> list[WeakCellTime]:
    """Return the times of weak cells."""
    saved = arrays.get("weak_cell_times")
    if saved is None or saved.dtype != float or saved.ndim != 2 or saved.shape[1] != len(WeakCellTime._fields):
        raise ValueError("the times of weak cells are damaged")
    start_s, end_s, soc = saved.T
    if not (is_within(start_s, TIME) and (end_s >= start_s).all() and is_within(soc, _SOC_RANGE)):
        raise ValueError("the times of weak cells are damaged")
    return [WeakCellTime(*row) for row in saved.tolist()]


def _first_discharges(arrays: Arrays) -> ReferenceDischarges | None:
    """Return the first discharges of a bank; None if none were saved."""
    fit = fit_from_arrays({name: arrays[BANK_PREFIX + name] for name in FIT_SHAPES if BANK_PREFIX + name in arrays})
    return None if fit is None else ReferenceDischarges(_rows(arrays, "bank_rows"), fit)


def _rows(arrays: Arrays, name: str) -> NDArray[np.void]:
    """Return saved rows of a history."""
    rows = checked_rows(arrays.get(name))
    if rows.size > MAX_ROWS:
        raise ValueError("the history has too many rows")
    return rows


def history_from_arrays(arrays: Arrays) -> tuple[History, PackFit | None]:
    """Return history and fit of ``history_arrays``.

    Raises:
        ValueError: A field is missing, or has another layout or an implausible value.
    """
    history = History(_rows(arrays, "rows"), _weak_cell_times(arrays), _first_discharges(arrays))
    fit = fit_from_arrays({name: value for name, value in arrays.items() if name in FIT_SHAPES})
    if fit is None:
        return history, None
    elapsed_s, soc, curves = (_fit_field(arrays, name) for name in ("row_elapsed_s", "row_soc", "curves"))
    if elapsed_s.shape != soc.shape or elapsed_s.ndim != 1 or not 0 < elapsed_s.size <= MAX_ROWS:
        raise ValueError("the SOCs of the fit are damaged")
    if curves.ndim != 2 or curves.shape[1] != _CURVE_UNKNOWNS or not 0 < curves.shape[0] <= SAVED_MINIMA:
        raise ValueError("the curves of the fit are damaged")
    if not history.rows.size or fit.segment > history.rows["segment"][-1]:
        raise ValueError("the fit is newer than the rows")
    return history, replace(fit, row_elapsed_s=elapsed_s, row_soc=soc, curves=tuple(curves))
