"""Weakest cell of a pack: by the cell voltages, or without them by the voltage of the bank."""

import math
from typing import Any, Literal, NamedTuple

from bms_estimator.pack.pack import Pack
from bms_estimator.telemetry.cells import weakest_cell_fields
from bms_estimator.telemetry.remaining_capacity import full_capacity_ah
from bms_estimator.telemetry.state import finite


class WeakestCell(NamedTuple):
    """Estimate of the weakest cell."""

    number: int | None
    """Number of the cell, from 1; None: unknown, because only the voltage of the bank is measured."""
    soc: float
    """SOC, 0..1."""
    std: float
    """Std of ``soc``."""
    capacity_ratio: float
    """Capacity relative to the other cells."""
    by: Literal["cell voltages", "bank voltage"]


def weakest_cell(pack: Pack) -> WeakestCell | None:
    """Return the present estimate of the weakest cell; None before the first one."""
    estimator, cells = pack.estimator, pack.cells.deviations if pack.cells else None
    if cells is not None:
        i = cells.weakest
        return WeakestCell(i + 1, cells.soc[i], cells.soc_std[i], cells.capacity_ratio[i], "cell voltages")
    weakest = pack.slow_fit.bank.weakest if pack.slow_fit and pack.slow_fit.bank else None
    if weakest is None or math.isnan(estimator.soc):
        return None
    soc, std = weakest.weakest_soc(estimator.soc)
    return WeakestCell(
        None, soc, math.hypot(std, estimator.record[0]["filter"]["soc_std"]), weakest.capacity_ratio, "bank voltage"
    )


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
