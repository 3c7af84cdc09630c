"""Linear model of the ladder fit: the unknowns, and their columns.

    v = E_o(SOC) + d(SOC) + (T - 25 C) u(SOC) - sum_k [w_k(SOC) g_w(T) + s_k(SOC) g_s(T)] x_k

x_0 is the current and x_k the current filtered by RC pair k. g_w and g_s are the Arrhenius factors of the resistances'
parts with weak and strong temperature dependence. w and s are these parts, piecewise linear over SOC. d is a correction
of the open-circuit voltage (cubic spline), u a correction of its temperature coefficient. u also absorbs the voltage that
a cold cell has not relaxed after half an hour. Without u, the slow RC pairs absorb that voltage, and the predicted drop of
a cold drive is twice too large.
"""

import numpy as np
from scipy.interpolate import BSpline

from bms_estimator.calibration.ocv.overpotential import arrhenius, linear_interpolation_matrix
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    RESISTANCES,
)
from bms_estimator.model.arrays import Floats

SOC_NODES = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.65, 0.85, 1.0])
"""SOC nodes of the resistances."""
KELVIN_NODES = np.array([0.0, 0.15, 0.3, 0.5, 0.75, 1.0])
"""SOC nodes of dE/dT."""
KNOTS = np.unique(np.round(np.r_[np.arange(0.0, 0.25, 0.025), np.arange(0.25, 1.0, 0.045), 1.0], 4))
"""SOC nodes of the correction of the OCV."""
SPLINES = KNOTS.size + 2
"""Number of spline coefficients of d."""
UNBOUNDED = SPLINES + KELVIN_NODES.size
"""Number of unknowns that may be negative. They precede the resistances."""
PART_SIZE = RESISTANCES * SOC_NODES.size
"""Number of unknowns in the weak part, and in the strong part, of the resistances."""


def correction_at(soc: Floats) -> Floats:
    """Return the cubic B-splines of d at ``soc``. Shape (n, SPLINES)."""
    knots = np.r_[np.zeros(3), KNOTS, np.ones(3)]
    return np.asarray(BSpline.design_matrix(np.clip(soc, 0.0, 1.0), knots, 3).toarray())


def model_rows(soc: Floats, temperature_c: Floats, currents: Floats) -> Floats:
    """Return the unweighted rows of the model. Shape (n, UNBOUNDED + 2 PART_SIZE)."""
    currents_at_nodes = currents[:, :, None] * linear_interpolation_matrix(soc, SOC_NODES)[:, None, :]
    drop_rows = currents_at_nodes.reshape(soc.size, -1)
    return np.hstack(
        [
            correction_at(soc),
            linear_interpolation_matrix(soc, KELVIN_NODES) * (temperature_c - REFERENCE_C)[:, None],
            -drop_rows * arrhenius(LOW_ACTIVATION_ENERGY, temperature_c)[:, None],
            -drop_rows * arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c)[:, None],
        ]
    )
