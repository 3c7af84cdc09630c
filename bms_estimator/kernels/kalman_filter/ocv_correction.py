"""The OCV learned while the filter runs: the error of the curve of the cell file as states of the filter, along SOC.

The fraction ``learned`` of the variance of that error belongs to the curve itself and returns at the same SOC. It is
blended between ``NODES`` states so that its variance stays, each in units of the curve's std there, correlated with its
neighbours over ``ALIKE_SOC``. The rest, CURVE, is of temperature, load and history, and is another each time.

A voltage depends on SOC and curve together, so its information on the curve is no more certain than the SOC was
without it. The
joint covariance holds exactly that, so no rule is needed which voltages may be learned from (the same with a map and a
place in it: Smith, Self and Cheeseman 1990).

``x`` is a mean of EKF_STATE, ``p`` a record of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import on_grid
from bms_estimator.kernels.kalman_filter.records import NODE, NODES
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

ALIKE_SOC = 0.6
"""Correlation length of the OCV's error [SOC]: cells of one chemistry differ in the used range of the electrodes."""
NEIGHBOURS = math.exp(-1.0 / (NODES - 1) / ALIKE_SOC)
"""Correlation of two nodes beside each other, before anything is learned."""


@njit(cache=True)
def node_position(soc: float) -> tuple[int, float]:
    """Return the node below ``soc``, and the fraction of the distance to the next one."""
    position = min(max(soc, 0.0), 1.0) * (NODES - 1)
    i = min(int(position), NODES - 2)
    return i, position - i


@njit(cache=True)
def node_error_scale(p: Record, soc: float, t: float) -> float:
    """Error of the curve at ``soc`` by nodes of 1 on both sides [V]: of the same variance between nodes as at them."""
    kept = 1.0 - 2.0 * t * (1.0 - t) * (1.0 - NEIGHBOURS)
    return on_grid(soc, p.curve_error_v) * math.sqrt(p.learned / kept)


@njit(cache=True)
def ocv_correction(p: Record, x: Floats, soc: float) -> float:
    """Return the learned correction of the cell file's OCV [V]."""
    i, t = node_position(soc)
    return node_error_scale(p, soc, t) * ((1.0 - t) * x[NODE + i] + t * x[NODE + i + 1])


@njit(cache=True)
def reset_ocv_correction(x: Floats, covariance: Floats) -> None:
    """Nothing is learned yet."""
    x[NODE : NODE + NODES] = 0.0
    covariance[NODE : NODE + NODES, :] = 0.0
    covariance[:, NODE : NODE + NODES] = 0.0
    for j in range(NODES):
        for k in range(NODES):
            covariance[NODE + j, NODE + k] = NEIGHBOURS ** abs(j - k)
