"""Conversion of history and fit to arrays that can be saved, and back."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.pack_model.cell_curves import SOC_GRID
from bms_estimator.pack_model.fit import CURVE, PackFit
from bms_estimator.pack_model.history import MAX_ROWS, History, ReferenceDischarges, WeakCellTime

SAVED_MINIMA = 2
"""Number of a fit's minima that are saved. The next fit starts from two minima (``fit.starts``)."""
_RESULTS = CURVE.stop
"""Number of results of a fit. ``CURVE`` is the last part of them."""
_SHAPES = {
    "elapsed_s": (),
    "segment": (),
    "charge_as": (),
    "mean": (_RESULTS,),
    "covariance": (_RESULTS, _RESULTS),
    "curve_v": (SOC_GRID.size,),
    "ln_r": (SOC_GRID.size, 3),
    "hysteresis": (),
    "cost": (),
    "first_segment": (),
}
"""Fields of a fit on which the curves and the handed-over state depend, with their shapes."""
_DEFAULTS: Mapping[str, NDArray[Any]] = {"first_segment": np.zeros(())}
"""Fields that an earlier version did not save, with their values: its fits used all segments."""
_NEW_ROW_FIELDS = {"between_a2", "skew_a2"}
"""Fields of a row that an earlier version did not save. They are variances, which it assumed to be 0."""
_START_FIELDS = "row_elapsed_s", "row_soc", "curves"
"""Fields of a fit from which the next fit starts."""

BANK = "bank_"
"""Prefix of the arrays of the first discharges of a bank and of the fit after them."""

Arrays = Mapping[str, NDArray[Any]]


def curve_arrays(fit: PackFit | None) -> dict[str, NDArray[Any]]:
    """Return the curves and results of a fit by name; empty without a fit."""
    return {} if fit is None else {name: np.array(getattr(fit, name)) for name in _SHAPES}


def fit_of_curves(arrays: Arrays) -> PackFit | None:
    """Return the fit of ``curve_arrays``, without the fields from which the next fit starts.

    Raises:
        ValueError: A field is missing, has another shape or is not finite.
    """
    if not arrays:
        return None
    values: dict[str, Any] = {}
    saved = {**_DEFAULTS, **arrays}
    for name, shape in _SHAPES.items():
        value = saved.get(name)
        if value is None or value.shape != shape or not np.isfinite(value).all():
            raise ValueError(f"{name} of the fit is missing or damaged")
        values[name] = value if shape else float(value)
    none = np.zeros(0)
    return PackFit(**values, row_elapsed_s=none, row_soc=none, curves=())


def _with_present_fields(rows: NDArray[Any] | None) -> NDArray[Any] | None:
    """Return rows with the fields that an earlier version did not save; other rows are returned unchanged."""
    kept = [name for name in HISTORY_ROW.names or () if name not in _NEW_ROW_FIELDS]
    if rows is None or [*(rows.dtype.names or ())] != kept:
        return rows
    if any(rows.dtype[name] != HISTORY_ROW[name] for name in kept):
        return rows
    result = np.zeros(rows.shape, HISTORY_ROW)
    for name in kept:
        result[name] = rows[name]
    return result


def neutral_fit() -> PackFit:
    """Return a fit that corrects nothing. The service adopts it before the first sample to compile the code."""
    values: dict[str, Any] = {name: np.zeros(shape) if shape else 0.0 for name, shape in _SHAPES.items()}
    values |= {"covariance": np.eye(_RESULTS), "hysteresis": 1.0}
    none = np.zeros(0)
    return PackFit(**values, row_elapsed_s=none, row_soc=none, curves=())


def history_arrays(history: History, fit: PackFit | None) -> dict[str, NDArray[Any]]:
    """Return history and fit as arrays by name."""
    weak_s = np.array(history.weak_cell_times).reshape(-1, len(WeakCellTime._fields))
    arrays = {"rows": history.rows, "weak_cell_times": weak_s, **curve_arrays(fit)}
    if history.first is not None:
        arrays["bank_rows"] = history.first.rows
        arrays |= {BANK + name: array for name, array in curve_arrays(history.first.fit).items()}
    if fit is not None:
        arrays |= {"row_elapsed_s": fit.row_elapsed_s, "row_soc": fit.row_soc}
        arrays["curves"] = np.array(fit.curves[:SAVED_MINIMA]).reshape(min(len(fit.curves), SAVED_MINIMA), -1)
    return arrays


def _weak_cell_times(arrays: Arrays) -> list[WeakCellTime]:
    """Return the times of weak cells. An earlier version did not save them."""
    saved = arrays.get("weak_cell_times", np.zeros((0, len(WeakCellTime._fields))))
    if saved.ndim != 2 or saved.shape[1] != len(WeakCellTime._fields) or np.isnan(saved).any():
        raise ValueError("the times of weak cells are damaged")
    return [WeakCellTime(*row) for row in saved.tolist()]


def _first_discharges(arrays: Arrays) -> ReferenceDischarges | None:
    """Return the first discharges of a bank; None if none were saved."""
    fit = fit_of_curves({name: arrays[BANK + name] for name in _SHAPES if BANK + name in arrays})
    return None if fit is None else ReferenceDischarges(_checked_rows(arrays.get("bank_rows")), fit)


def _checked_rows(saved: NDArray[Any] | None) -> NDArray[np.void]:
    """Return saved rows.

    Raises:
        ValueError: They have another layout, or are not finite or not in the order of time.
    """
    rows = _with_present_fields(saved)
    if rows is None or rows.dtype != HISTORY_ROW or rows.ndim != 1 or rows.size > MAX_ROWS:
        raise ValueError("its rows have another layout")
    if not all(
        np.isfinite(rows[name]).all() for name in ("elapsed_s", "duration_s", "segment", "voltage_v", "charge_as")
    ):
        raise ValueError("a row is not finite")
    if (np.diff(rows["segment"]) < 0.0).any():
        raise ValueError("its rows are not in the order of time")
    return rows


def history_of(arrays: Arrays) -> tuple[History, PackFit | None]:
    """Return history and fit of ``history_arrays``.

    Raises:
        ValueError: A field is missing, has another layout or is not finite.
    """
    history = History(_checked_rows(arrays.get("rows")), _weak_cell_times(arrays), _first_discharges(arrays))
    fit = fit_of_curves({name: value for name, value in arrays.items() if name in _SHAPES})
    if fit is None:
        return history, None
    elapsed_s, soc, starts = (arrays.get(name, np.zeros(0)) for name in _START_FIELDS)
    if elapsed_s.shape != soc.shape or elapsed_s.ndim != 1 or not np.isfinite(starts).all():
        raise ValueError("the starts of the next fit are damaged")
    return history, replace(fit, row_elapsed_s=elapsed_s, row_soc=soc, curves=tuple(starts))
