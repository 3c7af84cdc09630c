"""Saved state of a pack: arrays by name, and a reason for each part that is missing or refused."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from numpy.typing import NDArray

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

    record: Arrays = field(default_factory=dict)
    """Fields of ESTIMATOR_STATE by their names, as from ``fields``."""
    curves: Arrays = field(default_factory=dict)
    """Arrays of the fit to whose curves ``record`` is relative (``pack_model.saved.curve_arrays``); empty: the curves are those
    of the cell file."""
    cells: Arrays = field(default_factory=dict)
    """State of the estimators of single cells (``CellEstimator.saved_state``); empty without cell voltages."""
    history: Arrays = field(default_factory=dict)
    """History and last fit (``pack_model.saved.history_arrays``)."""
    load: Arrays = field(default_factory=dict)
    """Observed load (``forecast.saved_load.load_arrays``)."""
    gap_s: float = math.inf
    """Time since ``record`` was saved [s]; infinite if unknown."""
    declared: DeclaredValues | None = None
    """Declared values of the pack at the save; None: the present ones."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Reason why a part is empty, by its name; it begins with ``REFUSED`` if the part exists."""
