"""Remaining charge of a pack, and its weakest cell, found by the cell voltages or else by the voltage of the bank."""

import math
from typing import Any, NamedTuple

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.pack.pack import Pack
from bms_estimator.telemetry.cells import weakest_cell_fields
from bms_estimator.telemetry.state import finite


def remaining_capacity_ah(estimator: Estimator) -> float:
    """Return the charge down to SOC 0 [Ah]; NaN before the first sample.

    Args:
        estimator: Estimator; read only.
    """
    state = estimator.state[0]
    if not state["started"] or math.isnan(state["soc"]):
        return math.nan
    return float(state["soc"]) * full_capacity_ah(estimator)


def full_capacity_ah(estimator: Estimator) -> float:
    """Return the capacity [Ah] that the identifier has learned, after a sample; without an identifier, the declared capacity."""
    ratio = relative_capacity(estimator.record[0]).value if estimator.has_filter else 1.0
    return ratio * float(estimator.settings["capacity_as"][0]) / 3600.0


class WeakestCell(NamedTuple):
    """Estimate of the weakest cell."""

    soc: float
    """SOC, 0..1."""
    std: float
    """Std of ``soc``."""
    capacity_ratio: float
    """Capacity relative to the other cells."""


def weakest_cell(pack: Pack) -> WeakestCell | None:
    """Return the present estimate of the weakest cell; None before the first one."""
    estimator, cells = pack.estimator, pack.cells.deviations if pack.cells else None
    if cells is not None:
        i = cells.weakest
        return WeakestCell(cells.soc[i], cells.soc_std[i], cells.capacity_ratio[i])
    weakest = pack.slow_fit.bank.weakest if pack.slow_fit and pack.slow_fit.bank else None
    if weakest is None or math.isnan(estimator.soc):
        return None
    soc, std = weakest.weakest_soc(estimator.soc)
    return WeakestCell(soc, math.hypot(std, estimator.record[0]["filter"]["soc_std"]), weakest.capacity_ratio)


def estimate_fields(pack: Pack) -> dict[str, Any]:
    """Return the fields of ``Estimate`` about single cells; empty before their first estimate."""
    cell, cells = weakest_cell(pack), pack.cells.deviations if pack.cells else None
    if cell is None:
        return {}
    return {
        "weakest_cell_soc": finite(cell.soc),
        "weakest_cell_soc_std": finite(cell.std),
        "weakest_cell_capacity": finite(cell.capacity_ratio),
        "usable_capacity_to_weakest_ah": finite(cell.soc * cell.capacity_ratio * full_capacity_ah(pack.estimator)),
        **(weakest_cell_fields(cells) if cells else {}),
    }
