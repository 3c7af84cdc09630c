"""Values of single cells and of the weakest one: payload of the topic ``cells``, columns of a table, and inputs of the alarms."""

import math
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.kernels.cells.records import ReadingFault
from bms_estimator.model.arrays import Records
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.snapshot import CellFaultName, CellReport, CellsReport
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.telemetry.state import finite, full_capacity_ah


class WeakestCell(NamedTuple):
    """Estimate of the weakest cell."""

    number: int | None
    """Number of the cell, from 1; None if only the voltage of the bank, all cells in series, is measured."""
    soc: float
    """SOC, 0..1."""
    std: float
    """Std of ``soc``."""
    capacity_ratio: float
    """Capacity relative to the other cells."""
    source: CellDeviations | ComparedCell
    """Estimate that these values come from: all cells by their voltages, or one cell by the voltage of its bank."""


def weakest_by_cells(cells: CellDeviations) -> WeakestCell:
    """Return the cell with the lowest SOC."""
    i = cells.weakest
    return WeakestCell(i + 1, cells.soc[i], cells.soc_std[i], cells.capacity_ratio[i], cells)


def weakest_cell(pack: Pack) -> WeakestCell | None:
    """Return the present estimate of the weakest cell; None before the first one."""
    estimator = pack.estimator
    if pack.cells and pack.cells.deviations is not None:
        return weakest_by_cells(pack.cells.deviations)
    weakest = pack.slow_fit.bank.weakest if pack.slow_fit and pack.slow_fit.bank else None
    if weakest is None or math.isnan(estimator.soc):
        return None
    soc, std = weakest.weakest_soc(estimator.soc)
    soc_std = math.hypot(std, estimator.record[0]["filter"]["soc_std"])
    return WeakestCell(None, soc, soc_std, weakest.capacity_ratio, weakest)


def single_cell_fields(pack: Pack) -> dict[str, Any]:
    """Return the fields of ``Estimate`` about single cells; empty before their first estimate."""
    cell = weakest_cell(pack)
    if cell is None:
        return {}
    return {
        **weakest_cell_fields(cell),
        "weakest_cell_capacity": finite(cell.capacity_ratio),
        "usable_capacity_to_weakest_ah": finite(cell.soc * cell.capacity_ratio * full_capacity_ah(pack.estimator)),
    }


_FAULT_NAMES: dict[ReadingFault, CellFaultName] = {
    ReadingFault.STUCK: "stuck reading",
    ReadingFault.CONTACT: "contact",
    ReadingFault.OFFSET: "wrong reading",
    ReadingFault.SENSE_WIRE: "sense wire",
}

CELL_COLUMNS = np.dtype(
    [
        ("weakest_cell", "f8"),  # number of the cell with the lowest SOC, from 1
        ("weakest_cell_soc", "f8"),  # its SOC, 0..1
        ("weakest_cell_soc_std", "f8"),  # standard deviation of this SOC
        ("cell_soc_spread", "f8"),  # highest minus lowest SOC of the cells
        ("cell_r_spread", "f8"),  # highest minus lowest resistance, relative to the median
    ]
)
"""Columns about the cells in a table of estimates; NaN before the first estimate of the cells."""


class CellAlarmInput(NamedTuple):
    """Input of one alarm: the largest value of all cells, and the faulty cells."""

    value: float
    """Largest value of all cells, in the unit of the alarm's limit."""
    texts: tuple[str, ...] = ()
    """Description of each faulty cell, one sentence each."""
    kinds: tuple[tuple[int, ReadingFault], ...] = ()
    """Index and fault of each faulty cell. They show whether the faults have changed; ``texts`` also change with the measured
    values."""


NO_FAULTY_CELL = CellAlarmInput(0.0)


class CellAlarmInputs(NamedTuple):
    """Inputs of the alarms about the cells at one time, each over all cells."""

    at_s: float
    """Time on the samples' clock [s]."""
    short: CellAlarmInput
    """Largest lower bound of a cell's self-discharge current [A]; 0 if no self-discharge is significant."""
    reading: CellAlarmInput
    """Largest error of a cell's reading [V]."""


def cell_alarm_inputs(cells: CellDeviations) -> CellAlarmInputs:
    """Return the faults of the cells as inputs of the alarms."""
    proven_a = cells.proven_self_discharge_a
    i = int(np.argmax(proven_a))
    short_text = f"cell {i + 1} discharges itself by {cells.self_discharge_a[i]:.3g} A more than the other cells"
    faulty = [i for i, fault in enumerate(cells.fault) if fault]
    return CellAlarmInputs(
        cells.at_s,
        CellAlarmInput(max(float(proven_a[i]), 0.0), (short_text,)) if proven_a[i] > 0.0 else NO_FAULTY_CELL,
        CellAlarmInput(
            float(cells.reading_error_v.max()),
            tuple(_reading_text(cells, i) for i in faulty),
            tuple((i, cells.fault[i]) for i in faulty),
        ),
    )


def _reading_text(cells: CellDeviations, i: int) -> str:
    """Describe the faulty reading of cell ``i``, from 0."""
    error = f"the reading of cell {i + 1} is wrong by {1e3 * cells.reading_error_v[i]:.0f} mV"
    match cells.fault[i]:
        case ReadingFault.STUCK:
            return f"the reading of cell {i + 1} does not respond to the load"
        case ReadingFault.CONTACT:
            return f"a contact of cell {i + 1} has a resistance of {1e3 * cells.contact_ohm[i]:.2g} mΩ"
        case ReadingFault.SENSE_WIRE:
            return f"{error}, and that of a neighbor by the opposite: the sense wire between them is faulty"
    return error


def make_cells_payload(cells: CellDeviations, short_limit_a: float, now_s: float) -> CellsReport:
    """Return the payload of topic ``cells``.

    Args:
        cells: Deviations of the cells.
        short_limit_a: Minimum ``proven_self_discharge_a`` of a cell with an internal short [A].
        now_s: Wall clock [s since 1970].
    """
    is_short = cells.proven_self_discharge_a >= short_limit_a
    return CellsReport(
        publish_time=iso_utc(now_s),
        weakest=cells.weakest + 1,
        cells=[
            CellReport(
                number=i + 1,
                soc=float(cells.soc[i]),
                soc_std=float(cells.soc_std[i]),
                soc_deviation=float(cells.soc_deviation[i]),
                soc_deviation_std=float(cells.soc_deviation_std[i]),
                resistance_ratio=float(cells.resistance_ratio[i]),
                resistance_ratio_std=float(cells.resistance_ratio_std[i]),
                capacity_ratio=float(cells.capacity_ratio[i]),
                self_discharge_a=float(cells.self_discharge_a[i]),
                self_discharge_std_a=float(cells.self_discharge_std_a[i]),
                fault="internal short" if is_short[i] else _FAULT_NAMES.get(cells.fault[i]),
            )
            for i in range(cells.soc.size)
        ],
    )


def weakest_cell_fields(cell: WeakestCell) -> dict[str, float | int | None]:
    """Return the weakest cell and the spreads of the cells as fields of ``Estimate``.

    Without cell voltages the spreads are None.
    """
    cells = cell.source
    return {
        "weakest_cell": cell.number,
        "weakest_cell_soc": finite(cell.soc),
        "weakest_cell_soc_std": finite(cell.std),
        "cell_soc_spread": float(np.ptp(cells.soc_deviation)) if isinstance(cells, CellDeviations) else None,
        "cell_r_spread": float(np.ptp(cells.resistance_ratio)) if isinstance(cells, CellDeviations) else None,
    }


def cell_columns(cells: CellDeviations | None, count: int) -> Records:
    """Return the present values in ``count`` equal rows, dtype ``CELL_COLUMNS``; NaN without an estimate of the cells."""
    rows = np.full(count, math.nan).astype(CELL_COLUMNS)
    if cells is not None:
        for name, value in weakest_cell_fields(weakest_by_cells(cells)).items():
            rows[name] = math.nan if value is None else value
    return rows
