"""Stored history of a pack for a report."""

import time
from pathlib import Path

import numpy as np

from bms_estimator.checkpoint.arrays_file import RejectedFileError
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.estimator.estimator import new_estimator
from bms_estimator.estimator.identified_parameters import present_elements, relative_capacity
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import FuelCellModel
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack_model.aging_course import aging_course
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.saved import history_of
from bms_estimator.process.state_folder import state_folder
from bms_estimator.reports.aging_group import AgingHistory
from bms_estimator.reports.formats import number
from bms_estimator.reports.history_report import PackHistory
from bms_estimator.settings.pack import Settings
from bms_estimator.store.history_reader import HistoryReader
from bms_estimator.store.minute import MINUTE_S, Minute

CAPACITY = "capacity [Ah]"
"""Name of the learned capacity."""
MIN_VOLTAGE_RATIO = 0.6
"""Minimum voltage of a pack, relative to its nominal voltage. A full pack with half as many cells has less."""


def pack_history(settings: Settings, model: PackModel, folder: Path | None, since_s: float) -> PackHistory:
    """Return the history that the service of a pack has stored.

    Args:
        settings: Settings of the pack.
        model: Model of the whole pack.
        folder: State folder of the service; None: the folder in the settings.
        since_s: Start time [s since 1970].

    Raises:
        UserError: The history cannot be read, or has no rows.
    """
    path = (folder or state_folder(settings)) / f"{settings.pack.name}.sqlite"
    file, until_s = HistoryReader(path), time.time() + MINUTE_S
    rows = file.rows(since_s, until_s, MINUTE_S)
    if not rows:
        raise UserError(f"{path}: no rows in this period; the service stores one for each minute")
    table = np.array(rows, dtype=np.float64)  # None becomes NaN
    columns = dict(zip(Minute._fields, table.T, strict=True))
    files, learned = StateFiles(path.parent, settings, model), list[tuple[str, str, str]]()
    not_learned = ""
    try:
        learned = _learned_parameters(files, model)
    except UserError as error:
        not_learned = str(error)
    events = file.events(since_s, until_s)
    aging = _aging_history(files, settings, model)
    if aging.course:
        learned = [row for row in learned if row[0] != CAPACITY]  # the table of the slow fit has the capacity
    warnings = _implausible_voltages(model, columns["voltage_v"], path)
    return PackHistory(settings.pack.name, columns["time_s"], columns, events, learned, not_learned, aging, warnings)


def _implausible_voltages(model: PackModel, voltage_v: Floats, path: Path) -> list[str]:
    """Return a warning if a history has voltages that the pack cannot have, as from another pack of its name."""
    cell = model.cell
    low_v = 0.0 if isinstance(model, FuelCellModel) else MIN_VOLTAGE_RATIO * cell.nominal_voltage_v
    outside_v = voltage_v[(voltage_v < low_v) | (voltage_v > cell.voltage_max_v)]
    if outside_v.size == 0:
        return []
    text = (
        f"{outside_v.size:,} of {voltage_v.size:,} minutes have voltages from {outside_v.min():.2f} to {outside_v.max():.2f} V, "
        f"outside {low_v:.2f} to {cell.voltage_max_v:.2f} V, the range of {cell.series_count} cells in series. The sensor was "
        f"wrong, or {path} also has the history of an earlier pack of this name; to begin a new history, stop the service and "
        "rename the file."
    )
    return [text]


def _aging_history(files: StateFiles, settings: Settings, model: PackModel) -> AgingHistory:
    """Return capacity and resistances over the days of the history to which the service fits the pack's model."""
    if isinstance(model, FuelCellModel):
        return AgingHistory(None, "Only batteries have a capacity and resistances over days.")
    file = files.history
    try:
        arrays = file.load()
        rows, fit = history_of(arrays) if arrays else (None, None)
        if rows is None or fit is None:
            return AgingHistory(
                None,
                f"{file.path}: no fit yet; the service first fits capacity and resistances after half an hour of use.",
            )
        cell = CellCurves(new_estimator(settings, model).cell_file_settings)
        return AgingHistory(aging_course(cell, rows.rows, fit))
    except (RejectedFileError, OSError, ValueError) as error:
        return AgingHistory(None, f"{file.path} cannot be used: {error}.")


def _learned_parameters(files: StateFiles, model: PackModel) -> list[tuple[str, str, str]]:
    """Return name, value and std of the learned capacity and circuit elements.

    Raises:
        UserError: There is no valid checkpoint, or the pack is a fuel cell.
    """
    if isinstance(model, FuelCellModel):
        raise UserError("a fuel cell has no capacity and no elements over SOC")
    estimator = files.saved_pack().pack.estimator
    record, rated_ah = estimator.record[0], model.cell.capacity_ah
    capacity = relative_capacity(record)
    rows = [(CAPACITY, number(capacity.value * rated_ah), number(capacity.std * rated_ah, 2))]
    for name, element in present_elements(record).items():
        symbol, _, unit = name.rpartition("_")
        scale, label = (1e3, "mΩ") if unit == "ohm" else (1.0, "F")
        rows.append((f"{symbol.capitalize()} [{label}]", number(scale * element.value), number(scale * element.std, 2)))
    return rows
