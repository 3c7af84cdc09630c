"""Model of a pack of batteries or of fuel cell stacks, and the only place that decides which of both a file describes."""

from pathlib import Path

from bms_estimator.model.cell import CellModel, is_fuel_cell, load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import FuelCellModel, load_fuel_cell

PackModel = CellModel | FuelCellModel
"""Model of a pack of batteries or of fuel cell stacks."""


def load_any(name_or_path: str | Path, capacity_ah: float | None = None) -> PackModel:
    """Load a battery cell (``load_cell``) or a fuel cell (``load_fuel_cell``).

    Raises:
        UserError: No such cell or file, an invalid value, or a capacity for a fuel cell.
    """
    if not is_fuel_cell(name_or_path):
        return load_cell(name_or_path, capacity_ah)
    if capacity_ah is not None:
        raise UserError(f"{name_or_path} is a fuel cell, which has no capacity: leave out capacity_ah")
    return load_fuel_cell(name_or_path)
