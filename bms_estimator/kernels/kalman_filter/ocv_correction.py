"""Correction of the cell file's OCV curve, learned by the filter as states at SOC nodes.

One part of the curve's error, ``constant_error_v``, is the same each time the pack passes an SOC. It is interpolated between
``NODES`` states, scaled so that the variance between nodes equals that at nodes. The states are in units of its std and are
correlated over ``CORRELATION_SOC``. With a plateau they are correlated over the whole curve, so that only its level is learned.
The remaining error, CURVE, varies with temperature, load and history.

A voltage depends on SOC and curve together, so that its information on the curve is limited by the uncertainty of the SOC.
The joint covariance contains this limit, so that no rule has to select voltages for learning (as in simultaneous
localization and mapping: Smith, Self and Cheeseman 1990).

The nodes are learned in the first pass of the curve (``Noise.learning_soc``), because in a second pass the filter would take
the same errors for new information. Then they return to their prior, because their learned values have common errors with the
SOC of that pass. Their gain is 0: their error counts in the std, but voltages do not change them (Schmidt-Kalman filter).

``x`` is a mean of EKF_STATE, ``p`` a record of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import on_grid
from bms_estimator.kernels.kalman_filter.records import NODE, NODES
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

CORRELATION_SOC = 0.6
"""Correlation length of the OCV's error [SOC]. It is long, because cells of one chemistry differ in the used range of the
electrodes."""
NODE_CORRELATION = math.exp(-1.0 / (NODES - 1) / CORRELATION_SOC)
"""Prior correlation of two neighboring nodes of a cell without a plateau, and of the curve of a fit."""


@njit(cache=True)
def node_position(soc: float) -> tuple[int, float]:
    """Return the node below ``soc``, and the fraction of the distance to the next one."""
    position = min(max(soc, 0.0), 1.0) * (NODES - 1)
    i = min(int(position), NODES - 2)
    return i, position - i


@njit(cache=True)
def node_error_scale(p: Record, soc: float, t: float) -> float:
    """Return the scale of the interpolated node states at ``soc`` [V], normalized to a constant variance between nodes."""
    interpolated_variance = 1.0 - 2.0 * t * (1.0 - t) * (1.0 - p.node_correlation)
    return on_grid(soc, p.constant_error_v) / math.sqrt(interpolated_variance)


@njit(cache=True)
def ocv_correction(p: Record, x: Floats, soc: float) -> float:
    """Return the learned correction of the cell file's OCV [V]."""
    i, t = node_position(soc)
    return node_error_scale(p, soc, t) * ((1.0 - t) * x[NODE + i] + t * x[NODE + i + 1])


@njit(cache=True)
def reset_ocv_correction(p: Record, x: Floats, covariance: Floats) -> None:
    """Reset the nodes to their prior."""
    x[NODE : NODE + NODES] = 0.0
    covariance[NODE : NODE + NODES, :] = 0.0
    covariance[:, NODE : NODE + NODES] = 0.0
    for j in range(NODES):
        for k in range(NODES):
            covariance[NODE + j, NODE + k] = p.node_correlation ** abs(j - k)
