"""Two common estimators for comparison: EKFs with fixed parameters and two or five RC pairs."""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import HIGH_ACTIVATION_ENERGY, LOW_ACTIVATION_ENERGY, TAU_S, arrhenius
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

EKF_VOLTAGE_SIGMA_V = 0.005
"""Standard deviation of the measurement noise of the textbook filter [V]."""
FIVE_SIGMA_V = 0.1
"""Filter with five time constants: measurement noise of the voltage averaged over a second [V].

Of 5, 20, 50, 100 and 200 mV this value has the best result.
"""
FIVE_TAU_S = np.array([2.0, 15.0, 80.0, 400.0, 2000.0])
"""Time constants of the filter with five time constants [s]."""
INITIAL_VARIANCE = np.array([0.2**2, 0.01**2, 0.01**2])
"""Initial variances in every filter: of the SOC, and of two RC voltages [V^2]."""
WALK = np.array([1e-10, 1e-9, 1e-9])
"""Process noise of every filter: variance per second of the SOC, and of two RC voltages [V^2/s]."""
SOC_STEP = 1e-4
"""Half of the SOC interval over which the slope of the OCV is computed."""
COLD_C = 0.0
"""Temperature at which a resistance with one activation energy equals the sum of the weakly and the strongly temperature
dependent resistance of the cell file [C]."""


@njit(cache=True)
def _ocv_slope(soc: float, grid: Floats) -> float:
    """Return the slope of the OCV by a central difference [V]."""
    return (ocv(soc + SOC_STEP, grid[0], grid[1]) - ocv(soc - SOC_STEP, grid[0], grid[1])) / (2.0 * SOC_STEP)


@njit(cache=True)
def fixed_ekf(
    time_s: Floats, current_a: Floats, voltage_v: Floats, soc0: float, cell: Floats, grid: Floats
) -> tuple[Floats, Floats]:
    """Run an extended Kalman filter over (soc, v1, v2) with constant elements.

    Args:
        time_s: Shape (n,) [s].
        current_a: Shape (n,), positive on discharge [A].
        voltage_v: Shape (n,) [V].
        soc0: SOC at the first sample, 0..1.
        cell: Capacity [A s], R_s, R_1 [ohm], tau_1 [s], R_2 [ohm], tau_2 [s].
        grid: Shape (2, m): OCV and its slope over SOC 0..1 [V].

    Returns:
        SOC at each sample and its std, shape (n,) each.
    """
    capacity_as, r_s, r1, tau1, r2, tau2 = cell
    x = np.array([soc0, 0.0, 0.0])
    p = np.diag(INITIAL_VARIANCE)
    soc, std = np.empty(len(time_s)), np.empty(len(time_s))
    h = np.array([0.0, -1.0, -1.0])
    for k in range(len(time_s)):
        if k > 0:
            dt = max(time_s[k] - time_s[k - 1], 0.0)
            decay = np.array([1.0, math.exp(-dt / tau1), math.exp(-dt / tau2)])
            gain = np.array([-dt / capacity_as, r1 * (1.0 - decay[1]), r2 * (1.0 - decay[2])])
            x = decay * x + gain * current_a[k - 1]
            p = decay.reshape(3, 1) * p * decay + np.diag(WALK * dt)
        h[0] = _ocv_slope(x[0], grid)
        innovation = voltage_v[k] - (ocv(x[0], grid[0], grid[1]) - x[1] - x[2] - current_a[k] * r_s)
        ph = p @ h
        s = h @ ph + EKF_VOLTAGE_SIGMA_V**2
        x = x + ph / s * innovation
        p = p - np.outer(ph, ph) / s
        soc[k], std[k] = x[0], math.sqrt(p[0, 0])
    return soc, std


def five_branches(weak_ohm: Floats, strong_ohm: Floats) -> tuple[Floats, Floats]:
    """Convert the RC ladder of a cell file to the time constants ``FIVE_TAU_S``.

    The resistance of each RC pair is shared between the two nearest time constants, linearly in their logarithm.

    Args:
        weak_ohm: Resistances with weak temperature dependence, shape (GRID, RESISTANCES) [ohm].
        strong_ohm: Resistances with strong temperature dependence, shape (GRID, RESISTANCES) [ohm].

    Returns:
        R_s and five resistances at 25 C, shape (GRID, 6) [ohm], and an activation energy of each, shape (6,) [J/mol].
    """

    def share_between_nearest(ohm: Floats) -> Floats:
        """Return R_s and the resistances of the five time constants."""
        five = np.zeros((len(ohm), 6))
        five[:, 0] = ohm[:, 0]
        for k, tau_s in enumerate(TAU_S):
            position = float(np.interp(np.log(tau_s), np.log(FIVE_TAU_S), np.arange(5.0)))
            i = min(int(position), 3)
            five[:, 1 + i] += ohm[:, 1 + k] * (i + 1 - position)
            five[:, 2 + i] += ohm[:, 1 + k] * (position - i)
        return five

    weak, strong = share_between_nearest(weak_ohm), share_between_nearest(strong_ohm)
    middle = len(weak) // 2
    cold_ohm = weak[middle] * arrhenius(LOW_ACTIVATION_ENERGY, COLD_C) + strong[middle] * arrhenius(
        HIGH_ACTIVATION_ENERGY, COLD_C
    )
    ln_ratio = np.log(np.maximum(cold_ohm / np.maximum(weak[middle] + strong[middle], 1e-9), 1.0))
    return weak + strong, ln_ratio / math.log(arrhenius(1.0, COLD_C))


@njit(cache=True)
def ladder_ekf(
    time_s: Floats,
    current_a: Floats,
    voltage_v: Floats,
    temperature_c: Floats,
    soc0: float,
    capacity_as: float,
    ohm: Floats,
    energy_j: Floats,
    tau_s: Floats,
    grid: Floats,
) -> tuple[Floats, Floats]:
    """Run an extended Kalman filter over SOC and the voltages of five RC pairs.

    The resistances depend on SOC and temperature.

    Args:
        time_s: Shape (n,) [s].
        current_a: Shape (n,), positive on discharge [A].
        voltage_v: Shape (n,) [V].
        temperature_c: Shape (n,) [C].
        soc0: SOC at the first sample, 0..1.
        capacity_as: Capacity [A s].
        ohm: Resistances by ``five_branches`` [ohm].
        energy_j: Activation energies by ``five_branches`` [J/mol].
        tau_s: Time constants, shape (5,) [s].
        grid: Shape (2, m): OCV and its slope over SOC 0..1 [V].

    Returns:
        SOC at each sample and its std, shape (n,) each.
    """
    x = np.zeros(6)
    x[0] = soc0
    p = np.diag(np.append(INITIAL_VARIANCE, np.full(3, INITIAL_VARIANCE[1])))
    q = np.append(WALK, np.full(3, WALK[1]))
    soc, std = np.empty(len(time_s)), np.empty(len(time_s))
    h = -np.ones(6)
    r, decay = np.empty(6), np.ones(6)
    dt = 1.0
    for k in range(len(time_s)):
        position = min(max(x[0], 0.0), 1.0) * (len(ohm) - 1)
        i = min(int(position), len(ohm) - 2)
        for j in range(6):
            r[j] = (ohm[i, j] + (position - i) * (ohm[i + 1, j] - ohm[i, j])) * arrhenius(energy_j[j], temperature_c[k])
        if k > 0:
            dt = max(time_s[k] - time_s[k - 1], 0.0)
            decay[1:] = np.exp(-dt / tau_s)
            x = decay * x + (1.0 - decay) * r * current_a[k - 1]
            x[0] -= dt / capacity_as * current_a[k - 1]
            p = decay.reshape(6, 1) * p * decay + np.diag(q * dt)
        h[0] = _ocv_slope(x[0], grid)
        innovation = voltage_v[k] - (ocv(x[0], grid[0], grid[1]) - x[1:].sum() - current_a[k] * r[0])
        ph = p @ h
        # All samples of a second together have the weight of one sample.
        s = h @ ph + FIVE_SIGMA_V**2 / min(max(dt, 0.01), 1.0)
        x = x + ph / s * innovation
        p = p - np.outer(ph, ph) / s
        soc[k], std[k] = x[0], math.sqrt(max(p[0, 0], 0.0))
    return soc, std
