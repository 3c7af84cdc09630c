"""Saved state of a pack, and its conversion to another declared capacity after its setting was corrected."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cells.records import LEAK
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0
from bms_estimator.model.arrays import Records, fields
from bms_estimator.model.pack_model import PackModel

Arrays = Mapping[str, NDArray[Any]]
REFUSED = "refused: "
"""Prefix of the reason why a part was refused."""
CHECKPOINT, CURVES, CELLS, HISTORY, LOAD, CAPACITY = "checkpoint", "curves", "cells", "history", "load", "capacity"
"""Names of the parts in outcomes."""


class DeclaredValues(NamedTuple):
    """Values of a battery's model to which learned values are relative."""

    capacity_ah: float
    r_s_ohm: float

    @classmethod
    def of(cls, model: PackModel) -> "DeclaredValues | None":
        """Return the declared values of a model; None for a fuel cell."""
        return model.by_kind(lambda cell: cls(cell.capacity_ah, cell.r_s.offset_ohm), lambda _: None)


@dataclass(frozen=True)
class PackState:
    """State of a pack at a save. A part that is missing or refused is empty."""

    record: Arrays | Records = field(default_factory=dict)
    """Record of dtype ESTIMATOR_STATE, shape (1,); or its fields by their names, as from ``fields``."""
    curves: Arrays = field(default_factory=dict)
    """Arrays of the fit to whose curves ``record`` is relative (``pack_model.saved.curve_arrays``); empty: the curves are those
    of the cell file."""
    cells: Arrays = field(default_factory=dict)
    """State of the estimators of single cells (``CellEstimator.saved_state``); empty without cell voltages."""
    history: Arrays = field(default_factory=dict)
    """History and last fit (``pack_model.saved.history_arrays``)."""
    load: Arrays = field(default_factory=dict)
    """Observed load (``forecast.load_history.load_arrays``)."""
    gap_s: float = math.inf
    """Time since ``record`` was saved [s]; infinite if unknown."""
    declared: DeclaredValues | None = None
    """Declared values of the pack at the save; None: the present ones."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Reason why a part is empty, by its name; it begins with ``REFUSED`` if the part exists."""

    @property
    def record_fields(self) -> Arrays:
        """Fields of ``record`` by their names."""
        return dict(fields(self.record)) if isinstance(self.record, np.ndarray) else self.record


def with_capacity(
    state: PackState, before: DeclaredValues, after: DeclaredValues, filter_settings: np.void
) -> PackState:
    """Return a state with the values that are relative to the declared capacity or resistance converted.

    SOC, charges, and what was learned of capacity and resistances stay, in Ah and ohm. What was not learned follows the declared
    values: the posterior is divided by the old prior and multiplied by the new one. The fits of a history are dropped, because
    the next fit follows from its rows.

    Args:
        state: State of a pack whose declared values were ``before``.
        before: Declared values at the save.
        after: Present declared values.
        filter_settings: Record of dtype EKF_SETTINGS by the cell file.
    """
    ratio, ln_r = after.capacity_ah / before.capacity_ah, math.log(before.r_s_ohm / after.r_s_ohm)
    record = {name: v / ratio if name.endswith(".throughput_soc") else v for name, v in state.record_fields.items()}
    mean, covariance = record["filter.mean"].copy(), record["filter.covariance"]
    shifts = {LN_Q: (-math.log(ratio), float(filter_settings["capacity_std"]))}
    curves = dict(state.curves)
    if curves:  # the resistances of the state are relative to these curves
        curves["ln_r"] = curves["ln_r"] + ln_r
    else:
        shifts |= dict.fromkeys((LN_R0, LN_R), (ln_r, float(filter_settings["r_std"])))
        record["filter.step.ln_ratio"] = record["filter.step.ln_ratio"] + ln_r * _learned_fraction(
            record["filter.step.variance"], float(filter_settings["r_std"])
        )
    for j, (shift, prior_std) in shifts.items():
        mean[..., j] += shift * _learned_fraction(covariance[..., j, j], prior_std)
    record["filter.mean"] = mean
    cells = dict(state.cells)
    if "cells" in cells:
        cells["cells"] = _with_self_discharge(cells["cells"], ratio)
    history = {name: state.history[name] for name in ("rows", "weak_cell_times") if name in state.history}
    if "rows" in history:
        history["rows"] = history["rows"].copy()
        history["rows"]["throughput_soc"] /= ratio
    return replace(state, record=record, curves=curves, cells=cells, history=history)


def _learned_fraction(variance: NDArray[Any], prior_std: float) -> NDArray[Any]:
    """Return the fraction of a state's information that does not come from its prior, 0..1."""
    return np.clip(1.0 - variance / prior_std**2, 0.0, 1.0)


def _with_self_discharge(cells: NDArray[Any], ratio: float) -> NDArray[Any]:
    """Return the states of single cells with their self-discharge, a C-rate, relative to another capacity."""
    cells = cells.copy()
    cells["mean"][..., LEAK] /= ratio
    cells["covariance"][..., LEAK, :] /= ratio
    cells["covariance"][..., :, LEAK] /= ratio
    return cells
