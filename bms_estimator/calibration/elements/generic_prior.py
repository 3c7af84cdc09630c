"""Prior for values that captures do not determine: the generic cell with the most similar open-circuit voltage."""

import numpy as np

from bms_estimator.calibration.elements.initial_elements import InitialElements
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    arrhenius,
)
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv, generic_cells, load_cell

COMPARED_SOC = 0.1, 0.95
"""Lower and upper end of the SOC range in which OCV curves are compared. Outside, the steep ends would dominate the
difference."""
RESTS_STD = 0.35
"""Relative standard deviation of a ladder with the total resistance from rests and the distribution of a typical
cell."""


def nearest_generic_cell(soc: Floats, ocv_v: Floats, capacity_ah: float, series_count: int) -> CellModel:
    """Return the generic cell with the nearest OCV curve, scaled to the capacity and the number of cells in series.

    Args:
        soc: Shape (n,), increasing.
        ocv_v: Open-circuit voltage there [V].
        capacity_ah: Capacity of the returned cell [Ah].
        series_count: Cells in series.
    """
    cells = [load_cell(name, capacity_ah).pack(series_count, 1) for name in generic_cells()]
    return min(cells, key=lambda cell: ocv_rms_difference_v(cell, soc, ocv_v))


def ocv_rms_difference_v(cell: CellModel, soc: Floats, ocv_v: Floats) -> float:
    """Return the RMS difference between a generic cell's OCV and a curve at ``COMPARED_SOC`` [V].

    Args:
        cell: The generic cell.
        soc: Shape (n,), increasing.
        ocv_v: Open-circuit voltage there [V].
    """
    inside = (soc > COMPARED_SOC[0]) & (soc < COMPARED_SOC[1])
    curve_v = np.interp(soc[inside], *curve(cell, "ocv_v"))
    return float(np.sqrt(np.mean((curve_v - ocv_v[inside]) ** 2)))


def curve(cell: CellModel, column: str) -> tuple[Floats, Floats]:
    """Return SOC and a column of a generic cell's OCV table."""
    ocv = cell.ocv
    if not isinstance(ocv, TableOcv):
        raise TypeError(f"{cell.cell.name}: a generic cell must have an OCV table")
    return np.array(ocv.soc), np.array(getattr(ocv, column))


def scaled_generic_ladder(
    generic: CellModel, rests: InitialElements | None, temperature_c: float = REFERENCE_C
) -> Ladder:
    """Return the generic resistances over SOC, scaled to the resistances from rests.

    Rests do not show the growth of resistances in the cold and near empty. Therefore the growth of the
    generic cell is kept.

    Args:
        generic: Result of ``nearest_generic_cell``.
        rests: Elements from the rests; None: without scaling.
        temperature_c: Temperature of the rests [C].
    """
    ladder = generic.ladder
    if ladder is None:
        raise TypeError(f"{generic.cell.name}: a generic cell must have an RC ladder")
    if rests is None:
        return ladder
    weak_ohm, strong_ohm = np.array(ladder.weak_ohm), np.array(ladder.strong_ohm)
    total_ohm = (
        arrhenius(LOW_ACTIVATION_ENERGY, temperature_c) * weak_ohm
        + arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c) * strong_ohm
    )
    mid_soc_ohm = np.array([np.interp(0.5, ladder.soc, row) for row in total_ohm])
    # index 0 is the series resistance, the others are the RC pairs
    scale = np.full(mid_soc_ohm.size, (rests.r_ts_ohm + rests.r_tl_ohm) / mid_soc_ohm[1:].sum())
    scale[0] = rests.r_s_ohm / mid_soc_ohm[0]
    rows = {
        name: tuple(tuple(float(f"{ohm:.4g}") for ohm in row) for row in scale[:, None] * ohms)
        for name, ohms in (("weak_ohm", weak_ohm), ("strong_ohm", strong_ohm))
    }
    return ladder.model_copy(update={**rows, "std": RESTS_STD})
