"""Common estimators for comparison: EKFs with fixed parameters, a joint EKF, and RLS on the ARX form."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import STRONG_J, TAU_S, WEAK_J, arrhenius
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

EKF_VOLTAGE_SIGMA_V = 0.005
"""Standard deviation of the measurement noise of the textbook filter, and minimum in the joint filter [V]."""
ELEMENT_STD = 0.7
"""Joint filter: initial standard deviation of ln of each element; 0.7 is a factor of two."""
ELEMENT_WALK = 1e-6
"""Joint filter: variance of the random walk of ln of each element [1/s].

Of 1e-8, 1e-7 and 1e-6 this value has the smallest voltage error on the identification captures (docs/theory/comparison.md).
"""
NOISE_WINDOW_S = 60.0
"""Joint filter: time constant of the adaptation of the measurement noise to the innovations [s]."""
LN_SPAN = math.log(4.0)
"""Joint filter: bound of the change of ln of each element. Elements stay between a quarter and four times their start, as
in the observer."""
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
MAX_RLS_TRACE = 1e6
"""Recursive least squares: maximum trace of the covariance."""
COLD_C = 0.0
"""Temperature at which a resistance with one activation energy equals the sum of the weakly and the strongly temperature
dependent resistance of the cell file [C]."""


@njit()
def _ocv_slope(soc: float, grid: Floats) -> float:
    """Return the slope of the OCV by a central difference [V]."""
    return (ocv(soc + SOC_STEP, grid[0], grid[1]) - ocv(soc - SOC_STEP, grid[0], grid[1])) / (2.0 * SOC_STEP)


@njit()
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


@njit()
def joint_ekf(
    time_s: Floats, current_a: Floats, voltage_v: Floats, soc0: float, cell: Floats, grid: Floats
) -> tuple[Floats, Floats]:
    """Run a joint extended Kalman filter over (soc, v1, v2, ln R_s, ln R_1, ln tau_1, ln R_2, ln tau_2).

    The measurement noise is adapted to the innovations of the last minute, as in an adaptive EKF.

    Args:
        time_s: Shape (n,) [s].
        current_a: Shape (n,), positive on discharge [A].
        voltage_v: Shape (n,) [V].
        soc0: SOC at the first sample, 0..1.
        cell: Initial values: capacity [A s], R_s, R_1 [ohm], tau_1 [s], R_2 [ohm], tau_2 [s].
        grid: Shape (2, m): OCV and its slope over SOC 0..1 [V].

    Returns:
        SOC at each sample, shape (n,), and R_s, R_1, tau_1, R_2, tau_2, shape (n, 5).
    """
    x = np.zeros(8)
    x[0], x[3:] = soc0, np.log(cell[1:])
    p = np.diag(np.concatenate((INITIAL_VARIANCE, np.full(5, ELEMENT_STD**2))))
    q = np.concatenate((WALK, np.full(5, ELEMENT_WALK)))
    soc, elements = np.empty(len(time_s)), np.empty((len(time_s), 5))
    noise_v2, h = EKF_VOLTAGE_SIGMA_V**2, np.zeros(8)
    h[1], h[2] = -1.0, -1.0
    for k in range(len(time_s)):
        dt = 0.0
        if k > 0:
            dt = max(time_s[k] - time_s[k - 1], 0.0)
            f, i = np.eye(8), current_a[k - 1]
            x[0] -= dt / cell[0] * i
            for branch in range(2):
                r, tau = math.exp(x[4 + 2 * branch]), math.exp(x[5 + 2 * branch])
                decay = math.exp(-dt / tau)
                v = x[1 + branch]
                f[1 + branch, 1 + branch] = decay
                f[1 + branch, 4 + 2 * branch] = r * (1.0 - decay) * i  # by ln R
                f[1 + branch, 5 + 2 * branch] = (v - r * i) * decay * dt / tau  # by ln tau
                x[1 + branch] = decay * v + r * (1.0 - decay) * i
            p = f @ p @ f.T + np.diag(q * dt)
        ohmic_v = current_a[k] * math.exp(x[3])
        h[0] = _ocv_slope(x[0], grid)
        h[3] = -ohmic_v
        innovation = voltage_v[k] - (ocv(x[0], grid[0], grid[1]) - x[1] - x[2] - ohmic_v)
        ph = p @ h
        model_v2 = h @ ph
        # The expected square of the innovation is the variance of the model plus the variance of the noise.
        noise_v2 += min(dt / NOISE_WINDOW_S, 1.0) * (innovation**2 - model_v2 - noise_v2)
        noise_v2 = max(noise_v2, EKF_VOLTAGE_SIGMA_V**2)
        s = model_v2 + noise_v2
        x = x + ph / s * innovation
        x[0] = min(max(x[0], 0.0), 1.0)
        for j in range(5):  # every method of the comparison has these bounds
            start = math.log(cell[1 + j])
            x[3 + j] = min(max(x[3 + j], start - LN_SPAN), start + LN_SPAN)
        p = p - np.outer(ph, ph) / s
        p = 0.5 * (p + p.T)
        soc[k], elements[k] = x[0], np.exp(x[3:])
    return soc, elements


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
    cold_ohm = weak[middle] * arrhenius(WEAK_J, COLD_C) + strong[middle] * arrhenius(STRONG_J, COLD_C)
    ln_ratio = np.log(np.maximum(cold_ohm / np.maximum(weak[middle] + strong[middle], 1e-9), 1.0))
    return weak + strong, ln_ratio / math.log(arrhenius(1.0, COLD_C))


@njit()
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


@njit()
def rls_arx(current_a: Floats, overpotential_v: Floats, forgetting: float) -> Floats:
    """Run recursive least squares with forgetting on the ARX form of a model with two RC pairs.

    v[k] = c1 v[k-1] + c2 v[k-2] + c3 i[k] + c4 i[k-1] + c5 i[k-2] with the overpotential v = E_o - y.

    Args:
        current_a: Shape (n,), evenly sampled, positive on discharge [A].
        overpotential_v: Shape (n,) [V].
        forgetting: Factor per sample, below 1.

    Returns:
        Coefficients after each sample, shape (n, 5).
    """
    theta = np.zeros(5)
    p = np.eye(5) * 1e3
    history = np.zeros((len(current_a), 5))
    for k in range(2, len(current_a)):
        phi = np.array(
            [overpotential_v[k - 1], overpotential_v[k - 2], current_a[k], current_a[k - 1], current_a[k - 2]]
        )
        pp = p @ phi
        gain = pp / (forgetting + phi @ pp)
        theta = theta + gain * (overpotential_v[k] - phi @ theta)
        p = (p - np.outer(gain, pp)) / forgetting
        trace = np.trace(p)
        if trace > MAX_RLS_TRACE:  # without excitation, forgetting would let the covariance grow without limit
            p *= MAX_RLS_TRACE / trace
        history[k] = theta
    return history


def simulate_arx(coefficients: NDArray[np.float64], current_a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the overpotential of the ARX model under ``current_a`` [A], from rest. Shape (n,) [V]."""
    from scipy.signal import lfilter  # noqa: PLC0415 - scipy.signal is slow to import and used here only

    c1, c2, c3, c4, c5 = coefficients
    return np.asarray(lfilter([c3, c4, c5], [1.0, -c1, -c2], current_a))
