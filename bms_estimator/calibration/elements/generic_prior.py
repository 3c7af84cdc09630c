"""Prior from the shipped generic cell with the most similar open-circuit voltage, for values that captures do not determine."""

import numpy as np

from bms_estimator.calibration.elements.initial_elements import InitialElements
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C, STRONG_J, WEAK_J, arrhenius
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv, generic_cells, load_cell

INSIDE = 0.1, 0.95
"""SOC at which curves are compared: their ends are steep."""
RESTS_STD = 0.35
"""Relative standard deviation of resistances from rests, divided as in typical cells."""


def nearest_generic_cell(soc: Floats, ocv_v: Floats, capacity_ah: float, series_count: int) -> CellModel:
    """Return the generic cell of this capacity with the nearest OCV curve, as a pack of the same cells in series.

    Args:
        soc: Shape (n,), increasing.
        ocv_v: Open-circuit voltage there [V].
        capacity_ah: It is scaled to [Ah].
        series_count: Cells in series.
    """
    inside = (soc > INSIDE[0]) & (soc < INSIDE[1])

    def off_v(cell: CellModel) -> float:
        curve_v = np.interp(soc[inside], *curve(cell, "ocv_v"))
        return float(np.mean((curve_v - ocv_v[inside]) ** 2))

    cells = [load_cell(name, capacity_ah).pack(series_count, 1) for name in generic_cells()]
    return min(cells, key=off_v)


def curve(cell: CellModel, column: str) -> tuple[Floats, Floats]:
    """SOC and a column of a generic cell's table."""
    ocv = cell.ocv
    if not isinstance(ocv, TableOcv):
        raise TypeError(f"{cell.cell.name}: a generic cell has a table")
    return np.array(ocv.soc), np.array(getattr(ocv, column))


def scaled_generic_ladder(
    generic: CellModel, rests: InitialElements | None, temperature_c: float = REFERENCE_C
) -> Ladder:
    """Return the generic resistances over SOC, scaled to those of the rests. Rests do not show growth in the cold and near empty.

    Args:
        generic: Result of ``nearest_generic_cell``.
        rests: None: as large as the generic cell's.
        temperature_c: Temperature of the rests [C].
    """
    ladder = generic.ladder
    if ladder is None:
        raise TypeError(f"{generic.cell.name}: a generic cell has a ladder")
    if rests is None:
        return ladder
    weak_ohm, strong_ohm = np.array(ladder.weak_ohm), np.array(ladder.strong_ohm)
    there_ohm = arrhenius(WEAK_J, temperature_c) * weak_ohm + arrhenius(STRONG_J, temperature_c) * strong_ohm
    middle_ohm = np.array([np.interp(0.5, ladder.soc, row) for row in there_ohm])
    scale = np.full(middle_ohm.size, (rests.r_ts_ohm + rests.r_tl_ohm) / middle_ohm[1:].sum())
    scale[0] = rests.r_s_ohm / middle_ohm[0]
    rows = {
        name: tuple(tuple(float(f"{ohm:.4g}") for ohm in row) for row in scale[:, None] * ohms)
        for name, ohms in (("weak_ohm", weak_ohm), ("strong_ohm", strong_ohm))
    }
    return ladder.model_copy(update={**rows, "std": RESTS_STD})
