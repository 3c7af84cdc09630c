"""Present state of the pack and its voltage as a function of SOC, from which each draw starts.

``m`` is a record of PROJECTED_PACK, ``s`` of EKF_STATE, ``p`` of EKF_SETTINGS. Voltages and resistances are of the whole pack.
The parameters of the draws were chosen with discharges of real captures (docs/theory/forecast.md).
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, REFERENCE_C, RESISTANCES, arrhenius, on_grid
from bms_estimator.kernels.kalman_filter.ocv_correction import ocv_correction
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    OFFSET,
    SOC,
    X,
)
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

SOC_STD_FACTOR = 0.5
"""Factor on the filter's std of the SOC in the draws. With the full std, an error that SOC and biases share would count twice."""
MIN_SOC_STD = 0.02
"""Minimum std of the SOC, added in quadrature to that of the filter [SOC]."""
CAPACITY_STD_FACTOR = 0.5
"""Factor on the filter's std of the capacity in the draws."""
VOLTAGE_STD_V = 0.02
"""Std of the voltage error of one cell's model at 25 C, constant until the cut-off [V]."""
VOLTAGE_ERROR_ENERGY = 22e3
"""Activation energy of the variance of the voltage error [J/mol]."""
RESISTANCE_MEAN = 1.05
"""Mean factor on the voltage drop of the present model."""
RESISTANCE_STD = 0.05
"""Std of the factor on the voltage drop."""
GROWTH_SOC = 0.4
"""SOC below which the fast resistances R_0 and R_1 grow beyond those of the cell file."""
GROWTH = 0.75
"""Relative growth of the fast resistances from ``GROWTH_SOC`` to SOC 0, beyond that of the cell file, at 25 C. Few captures for
cell files contain large currents near empty. The growth increases with the Arrhenius factor of ``LOW_ACTIVATION_ENERGY`` in the
cold. Without growth, or with growth of all resistances, the forecasts of real captures are worse (docs/theory/forecast.md)."""
FAST_RESISTANCES = 2
"""Number of fast resistances: R_0 and R_1. They decide the voltage at the peaks of a load, at which discharges end."""
SURFACE_S = 15.0
"""Charge by which the surface of the particles is emptier than their mean, per ampere of the peak current [A s / A], at 25 C.
Diffusion in the particles needs this gradient. The SOC at the surface determines the voltage, so that the knee near empty comes earlier
under large currents. The gradient increases with the Arrhenius factor of ``LOW_ACTIVATION_ENERGY`` in the cold."""

PROJECTED_PACK = np.dtype(
    [
        ("soc", "f8"),  # SOC that the filter estimates
        ("surface_soc", "f8"),  # mean SOC of the particles minus that of their surface, at the peaks of the load
        ("capacity_as", "f8"),  # capacity that the filter estimates [A s]
        ("offset_a", "f8"),  # measured minus true current [A]
        ("x_a", "f8", BRANCHES),  # filtered currents of the RC pairs [A]
        ("bias_v", "f8"),  # present error of the model; near empty it is mainly a shift of the knee, which persists [V]
        ("cutoff_v", "f8"),
        ("soc_std", "f8"),
        ("weakest_std", "f8"),  # std of the weakest cell's SOC below the mean, per unit of SOC discharged
        ("capacity_std", "f8"),  # std of ln capacity
        ("voltage_std_v", "f8"),
        ("resistance_mean", "f8"),  # mean factor on the voltage drop
        ("resistance_std", "f8"),
        ("voltage_v", "f8", OCV_POINTS),  # voltage without load over SOC 0..1, after a discharge to that SOC [V]
        ("end_slope_v", "f8"),  # slope with which the voltage continues below SOC 0 [V]
        ("ohm", "f8", (RESISTANCES, GRID)),  # resistances over SOC 0..1 [ohm]
    ],
    align=True,
)
"""Present state of a pack, its curves, and the parameters of the distribution of the draws."""


@njit(cache=True)
def project_pack(m: Record, s: Record, p: Record, cutoff_v: float, peak_a: float) -> None:
    """Write the pack to ``m``, as the most likely hypothesis of the filter estimates it.

    Args:
        m: Record of PROJECTED_PACK; written.
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        peak_a: Largest current of the expected load [A]. The mean current of the last ten minutes applies if it is larger.
    """
    x, cov = s.mean[s.best], s.covariance[s.best]
    m.soc, m.cutoff_v, m.offset_a = x[SOC], cutoff_v, x[OFFSET]
    m.capacity_as = p.capacity_as * math.exp(x[LN_Q])
    for k in range(BRANCHES):
        m.x_a[k] = s.x_a[k] + x[X + k]
    m.bias_v = x[B_SLOW] + x[B_FAST]
    m.soc_std = math.sqrt((SOC_STD_FACTOR * s.soc_std) ** 2 + MIN_SOC_STD**2)
    m.weakest_std = p.cell_spread if p.series > 1.0 else 0.0
    m.capacity_std = CAPACITY_STD_FACTOR * math.sqrt(cov[LN_Q, LN_Q])
    m.voltage_std_v = VOLTAGE_STD_V * p.series * math.sqrt(arrhenius(VOLTAGE_ERROR_ENERGY, s.temperature_c))
    m.resistance_mean, m.resistance_std = RESISTANCE_MEAN, RESISTANCE_STD
    m.surface_soc = SURFACE_S * max(s.weak, 1.0) * max(peak_a, s.mean_a, 0.0) / m.capacity_as
    project_voltage(m, s, p)
    project_resistances(m, s, p)


@njit(cache=True)
def project_voltage(m: Record, s: Record, p: Record) -> None:
    """Write the voltage without load over the SOC. The hysteresis approaches -1 during the discharge to each SOC."""
    x = s.mean[s.best]
    for j in range(OCV_POINTS):
        soc = j / (OCV_POINTS - 1)
        discharged = max(m.soc - soc, 0.0)
        hysteresis = -1.0 + (x[HYST] + 1.0) * math.exp(-discharged / p.hysteresis_soc)
        m.voltage_v[j] = (
            p.ocv_v[j]
            + s.hysteresis * on_grid(soc, p.hysteresis_v) * hysteresis
            + on_grid(soc, p.varying_error_v) * x[CURVE]
            + ocv_correction(p, x, soc)
            + (s.temperature_c - REFERENCE_C) * on_grid(soc, p.per_kelvin_v)
        )
    m.end_slope_v = p.ocv_slope_v[0]


@njit(cache=True)
def project_resistances(m: Record, s: Record, p: Record) -> None:
    """Write the resistances over the SOC, with the filter's factors and the growth towards empty."""
    x = s.mean[s.best]
    for k in range(RESISTANCES):
        factor = math.exp(x[LN_R0 if k == 0 else LN_R])
        for n in range(GRID):
            m.ohm[k, n] = factor * (s.weak * p.weak_ohm[n, k] + s.strong * p.strong_ohm[n, k])
            if k < FAST_RESISTANCES:
                m.ohm[k, n] *= growth_factor(s, m.soc, n / (GRID - 1))


@njit(cache=True)
def growth_factor(s: Record, from_soc: float, to_soc: float) -> float:
    """Return the growth of the fast resistances beyond that of the cell file between two SOCs, as a factor of at least 1.

    The filter's factors on the resistances already contain the growth down to the present SOC.
    """
    return 1.0 + GROWTH * max(s.weak, 1.0) * max(growth_fraction(to_soc) - growth_fraction(from_soc), 0.0)


@njit(cache=True)
def growth_fraction(soc: float) -> float:
    """Return the fraction of the growth that applies at ``soc``: 0 above ``GROWTH_SOC``, 1 at SOC 0, linear in between."""
    return min(max(1.0 - soc / GROWTH_SOC, 0.0), 1.0)


@njit(cache=True)
def voltage_without_load(m: Record, soc: float) -> float:
    """Return the voltage without load at ``soc``, linear between its points [V]."""
    if soc <= 0.0:
        return m.voltage_v[0] + soc * m.end_slope_v
    position = min(soc, 1.0) * (OCV_POINTS - 1)
    i = min(int(position), OCV_POINTS - 2)
    return m.voltage_v[i] + (position - i) * (m.voltage_v[i + 1] - m.voltage_v[i])


@njit(cache=True)
def grid_position(soc: float) -> tuple[int, float]:
    """Return the node of the resistances below ``soc``, and the fraction of the distance to the next one."""
    position = min(max(soc, 0.0), 1.0) * (GRID - 1)
    i = min(int(position), GRID - 2)
    return i, position - i
