"""States of the filter for the single cells that limit power and capacity of a pack in series.

Each cell has a share of a limit of the pack's voltage: the limit divided by the number of cells in series. A pack whose cells all
equal one cell reaches the limit when this cell reaches its share.
"""

import numpy as np

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.kernels.kalman_filter.records import LN_Q, LN_R, LN_R0, SOC
from bms_estimator.model.arrays import Records


def discharge_limiting_states(state: Records, cells: CellDeviations | None) -> list[Records]:
    """Return states of packs whose cells all equal one of the cells that may limit a discharge.

    These are the cell with the least charge and the cell with the largest resistance.
    """
    if cells is None:
        return []
    least_charge, largest_r = np.argmin(cells.soc * cells.capacity_ratio), np.argmax(cells.resistance_ratio)
    return [state_of_cell(state, cells, i) for i in {int(least_charge), int(largest_r)}]


def charge_limiting_states(state: Records, cells: CellDeviations | None) -> list[Records]:
    """Return states of packs whose cells all equal one of the cells that may limit a charge.

    These are the cell with the highest SOC and the cell with the largest resistance.
    """
    if cells is None:
        return []
    return [state_of_cell(state, cells, i) for i in {int(np.argmax(cells.soc)), int(np.argmax(cells.resistance_ratio))}]


def state_of_cell(state: Records, cells: CellDeviations, i: int) -> Records:
    """Return the filter's state of a pack whose cells all have SOC, resistance and capacity of cell ``i``, from 0.

    Args:
        state: Shape (1,), dtype EKF_STATE, of the pack; read only.
        cells: Deviations of the single cells.
        i: Index of the cell.
    """
    shifted = state.copy()
    mean, covariance = shifted["mean"][0], shifted["covariance"][0]
    mean[:, SOC] += cells.soc_deviation[i]
    covariance[:, SOC, SOC] += cells.soc_deviation_std[i] ** 2
    mean[:, [LN_R0, LN_R]] += np.log(cells.resistance_ratio[i])
    mean[:, LN_Q] += np.log(cells.capacity_ratio[i])
    return shifted
