"""Cell model of Chen and Mora: elements over SOC, and exact response to a constant current.

Numbers in parentheses are equations of the thesis.

Parameters have their own index: ``a[1]`` is a1, ``a[0]`` is unused. Voltages in V, currents in A
(positive on discharge), resistances in ohm, capacitances in F, SOC 0..1.
"""

import math

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

PARAMETERS = 16
"""Length of an array with a1..a15 at index 1..15; index 0 is unused."""

State = tuple[float, float, float]
"""SOC (0..1), v_ts [V], v_tl [V]."""

OCV_POINTS = 401
"""Number of nodes of the OCV grid, evenly spaced over SOC 0..1."""
INVERSE_ERROR_V = 1e-10
"""Tolerance of the voltage when the OCV is inverted [V]."""
MAX_ITERATIONS = 50
"""Maximum number of iterations when the OCV is inverted."""


@njit(cache=True)
def r_ts(soc: float, a: Floats) -> float:
    """Return the short-term resistance R_ts(SOC) [ohm], (2.5)."""
    return a[1] * math.exp(-a[2] * soc) + a[3]  # (2.5)


@njit(cache=True)
def r_tl(soc: float, a: Floats) -> float:
    """Return the long-term resistance R_tl(SOC) [ohm], (2.6)."""
    return a[4] * math.exp(-a[5] * soc) + a[6]  # (2.6)


@njit(cache=True)
def c_ts(soc: float, a: Floats) -> float:
    """Return the short-term capacitance C_ts(SOC) [F], (2.7); negative at SOCs below delta1, see ``delta``."""
    return -a[7] * math.exp(-a[8] * soc) + a[9]  # (2.7)


@njit(cache=True)
def c_tl(soc: float, a: Floats) -> float:
    """Return the long-term capacitance C_tl(SOC) [F], (2.8); negative at SOCs below delta2, see ``delta``."""
    return -a[10] * math.exp(-a[11] * soc) + a[12]  # (2.8)


@njit(cache=True)
def r_s(soc: float, a: Floats) -> float:
    """Return the series resistance R_s(SOC) [ohm], (2.9)."""
    return a[13] * math.exp(-a[14] * soc) + a[15]  # (2.9)


@njit(cache=True)
def emf(soc: float, a: Floats) -> float:
    """Return the open-circuit EMF E_o(SOC) [V], (2.10)."""
    return -a[16] * math.exp(-a[17] * soc) + a[18] + a[19] * soc - a[20] * soc**2 + a[21] * soc**3  # (2.10)


@njit(cache=True)
def ocv(soc: float, ocv_v: Floats, ocv_slope_v: Floats) -> float:
    """Return the open-circuit voltage [V] at ``soc`` by cubic Hermite interpolation of a grid of values and slopes.

    Beyond 0..1 the curve continues with its end slope, so that it is finite and increasing for a drifting SOC.

    Args:
        soc: State of charge.
        ocv_v: Voltage at ``OCV_POINTS`` evenly spaced SOCs [V].
        ocv_slope_v: dOCV/dSOC at the same SOCs [V].
    """
    last = ocv_v.shape[0] - 1
    if soc <= 0.0:
        return ocv_v[0] + soc * ocv_slope_v[0]
    if soc >= 1.0:
        return ocv_v[last] + (soc - 1.0) * ocv_slope_v[last]
    position = soc * last
    i = min(int(position), last - 1)
    t = position - i
    u = 1.0 - t
    rise, left, right = ocv_v[i + 1] - ocv_v[i], ocv_slope_v[i], ocv_slope_v[i + 1]
    return ocv_v[i] + t * t * (3.0 - 2.0 * t) * rise + t * u * (1.0 / last) * (u * left - t * right)


@njit(cache=True)
def ocv_of_each(soc: Floats, ocv_v: Floats, ocv_slope_v: Floats) -> Floats:
    """Return ``ocv`` at each SOC of an array, shape (n,) [V]."""
    voltage_v = np.empty(soc.size)
    for j in range(soc.size):
        voltage_v[j] = ocv(soc[j], ocv_v, ocv_slope_v)
    return voltage_v


@njit(cache=True)
def soc_from_ocv(voltage_v: float, ocv_v: Floats, ocv_slope_v: Floats) -> float:
    """Return the SOC (0..1) whose open-circuit voltage is ``voltage_v`` [V]: inverse of ``ocv``, section 7.1 of the thesis.

    The search bisects the nodes and uses false position (Illinois) between two nodes. It converges for every increasing
    curve. Outside the curve's range the result is the nearest end.
    """
    last = ocv_v.shape[0] - 1
    if voltage_v <= ocv_v[0]:
        return 0.0
    if voltage_v >= ocv_v[last]:
        return 1.0
    below, above = 0, last
    while above - below > 1:
        middle = (below + above) // 2
        if ocv_v[middle] < voltage_v:
            below = middle
        else:
            above = middle
    low, high = below / last, above / last
    error_low, error_high = ocv_v[below] - voltage_v, ocv_v[above] - voltage_v
    side = 0
    soc = low
    for _ in range(MAX_ITERATIONS):
        soc = (low * error_high - high * error_low) / (error_high - error_low)
        error = ocv(soc, ocv_v, ocv_slope_v) - voltage_v
        if abs(error) < INVERSE_ERROR_V:
            break
        if error < 0.0:
            low, error_low = soc, error
            error_high *= 0.5 if side == -1 else 1.0
            side = -1
        else:
            high, error_high = soc, error
            error_low *= 0.5 if side == 1 else 1.0
            side = 1
    return soc


@njit(cache=True)
def rc_step(v_rc: float, current_a: float, r_ohm: float, tau_s: float, dt_s: float) -> float:
    """Return the voltage of an RC pair after ``dt_s`` under constant current, (2.2)-(2.3) solved exactly [V]."""
    decay = math.exp(-dt_s / tau_s)
    return v_rc * decay + current_a * r_ohm * (1.0 - decay)


@njit(cache=True)
def cell_step(x: State, current_a: float, dt_s: float, capacity_as: float, a: Floats) -> State:
    """Return the state x = (soc, v_ts, v_tl) after ``dt_s`` under constant current, (2.1)-(2.3).

    The elements are those at the SOC in the middle of the step, which makes the step second order in ``dt_s``.

    Args:
        x: SOC (0..1), v_ts [V], v_tl [V].
        current_a: Discharge current over the step [A].
        dt_s: Step [s].
        capacity_as: Capacity C_c [A s].
        a: a1..a21 at index 1..21.
    """
    soc, v_ts, v_tl = x
    drop = current_a * dt_s / capacity_as
    mid_soc = soc - 0.5 * drop
    ohm_ts = r_ts(mid_soc, a)
    ohm_tl = r_tl(mid_soc, a)
    return (
        soc - drop,  # (2.1)
        rc_step(v_ts, current_a, ohm_ts, ohm_ts * c_ts(mid_soc, a), dt_s),  # (2.2)
        rc_step(v_tl, current_a, ohm_tl, ohm_tl * c_tl(mid_soc, a), dt_s),  # (2.3)
    )


@njit(cache=True)
def terminal_voltage(x: State, current_a: float, a: Floats) -> float:
    """Return the terminal voltage y [V] of state x under ``current_a``, (2.4)."""
    soc, v_ts, v_tl = x
    return emf(soc, a) - v_ts - v_tl - current_a * r_s(soc, a)  # (2.4)


@njit(cache=True)
def simulate_cell(x: State, time_s: Floats, current_a: Floats, capacity_as: float, a: Floats) -> tuple[Floats, Floats]:
    """Simulate terminal voltage [V] and SOC under a current that is constant between samples, (2.1)-(2.4).

    Args:
        x: State at the first sample: SOC (0..1), v_ts [V], v_tl [V].
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), discharge positive [A]; ``current_a[j]`` flows from ``time_s[j]`` to ``time_s[j + 1]``.
        capacity_as: Capacity C_c [A s].
        a: a1..a21 at index 1..21.

    Returns:
        Two arrays of shape (n,): terminal voltage [V] and SOC (0..1).
    """
    n = time_s.shape[0]
    voltage_v = np.empty(n)
    soc = np.empty(n)
    for j in range(n):
        if j > 0:
            x = cell_step(x, current_a[j - 1], time_s[j] - time_s[j - 1], capacity_as, a)
        soc[j] = x[0]
        voltage_v[j] = terminal_voltage(x, current_a[j], a)
    return voltage_v, soc


@njit(cache=True)
def delta(exponent: float, offset: float, amplitude: float) -> float:
    """Return the SOC below which a capacitance -amplitude e^(-exponent SOC) + offset is negative: (2.11), (2.12).

    delta1 = delta(a8, a9, a7), delta2 = delta(a11, a12, a10). The result is negative if the capacitance is positive over
    the whole of 0..1.
    """
    return -math.log(offset / amplitude) / exponent  # (2.11), (2.12)


@njit(cache=True)
def min_stable_exponent(soc: float, offset: float, amplitude: float) -> float:
    """Return the exponent a8 (a11) above which C_ts (C_tl) is positive at ``soc``: Lemma 4.1.1 and Fig. 19 of the thesis.

    ``offset`` and ``amplitude`` are those of ``delta``.
    """
    return -math.log(offset / amplitude) / soc
