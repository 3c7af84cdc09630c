"""SOC by interpolation in the open-circuit curve, thesis 7.1."""

import numpy as np

from bms_estimator.calibration.thesis.prediction import Prediction, open_circuit
from bms_estimator.kernels.cell_model.chen_mora import r_s
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel

GRID = np.linspace(0.0, 1.0, 4001)


def soc_by_interpolation(cell: CellModel, run: Prediction) -> tuple[Floats, Floats]:
    """SOC from the measured voltage and the model's overpotentials.

    E_o = y + x2 + x3 + i R_s (2.4), looked up in the inverse of E_o(SOC). R_s and the overpotentials depend on SOC but
    weakly, they are taken at the counted one.

    Returns:
        SOC (0..1) and E_o [V], each of the run's shape. Outside the curve the nearest end of it.
    """
    a = cell.a
    ohmic_v = run.current_a * np.array([r_s(x, a) for x in run.soc])
    e_o = run.voltage_v + run.overpotential_v + ohmic_v  # (2.4) solved for E_o
    return np.interp(e_o, open_circuit(cell, GRID), GRID), e_o
