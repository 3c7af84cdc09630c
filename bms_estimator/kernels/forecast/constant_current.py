"""Terminal voltage of the pack after a constant current, predicted by the filter's model.

    v(t) = E_o(z, T) + M h + c e - e^s0 R_0 i - e^s sum R_k x_k + b_slow + b_fast

M h is the hysteresis, c e the error of the OCV curve, and b the biases. e^s0 and e^s are the factors on the resistances.
The response of the RC pairs is exact: x_k(t) = i + (x_k(0) - i) e^(-t / tau_k). OCV and resistances are those at the SOC after
the charge i t. The biases decay with their time constants. The temperature is constant.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS, and ``q`` the index of a hypothesis. Currents are positive on discharge.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, REFERENCE_C, TAUS, on_grid, resistances
from bms_estimator.kernels.kalman_filter.ocv_correction import ocv_correction
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    SOC,
    X,
)
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit


@njit(cache=True)
def hypothesis_capacity(s: Record, p: Record, q: int) -> float:
    """Return the capacity of hypothesis ``q`` [A s]."""
    return p.capacity_as * math.exp(s.mean[q, LN_Q])


@njit(cache=True)
def branch_current(s: Record, q: int, k: int, current_a: float, elapsed_s: float) -> float:
    """Return the filtered current of RC pair ``k`` after ``elapsed_s`` of the constant current [A]."""
    return current_a + (s.x_a[k] + s.mean[q, X + k] - current_a) * math.exp(-elapsed_s / TAUS[k])


@njit(cache=True)
def open_circuit_voltage(s: Record, p: Record, q: int, soc: float, elapsed_s: float) -> float:
    """Return the terminal voltage without the overpotential [V]: OCV with its corrections, hysteresis and biases.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        soc: SOC at the end of ``elapsed_s``. All charge since now has flowed in one direction.
        elapsed_s: Time from now, over which the biases decay [s].
    """
    x = s.mean[q]
    moved_soc = soc - x[SOC]
    hysteresis_decay = math.exp(-abs(moved_soc) / p.hysteresis_soc)
    h = hysteresis_decay * x[HYST] + math.copysign(1.0 - hysteresis_decay, moved_soc)
    curve = x[CURVE] * math.exp(-abs(moved_soc) / on_grid(x[SOC], p.curve_soc))
    voltage_v = ocv(soc, p.ocv_v, p.ocv_slope_v) + ocv_correction(p, x, soc)
    voltage_v += (s.temperature_c - REFERENCE_C) * on_grid(soc, p.per_kelvin_v)
    voltage_v += s.hysteresis * on_grid(soc, p.hysteresis_v) * h
    voltage_v += on_grid(soc, p.varying_error_v) * curve
    return voltage_v + x[B_SLOW] * math.exp(-elapsed_s / p.slow_s) + x[B_FAST] * math.exp(-elapsed_s / p.fast_s)


@njit(cache=True)
def scaled_resistances(s: Record, p: Record, q: int, soc: float, ohm: Floats) -> None:
    """Write the resistances R_0..R_6 at ``soc``, scaled by the hypothesis, to ``ohm`` [ohm]."""
    x = s.mean[q]
    resistances(soc, p.weak_ohm, p.strong_ohm, s.weak, s.strong, ohm)
    ohm[0] *= math.exp(x[LN_R0])
    factor = math.exp(x[LN_R])
    for k in range(1, 1 + BRANCHES):
        ohm[k] *= factor


@njit(cache=True)
def voltage_after(s: Record, p: Record, q: int, current_a: float, elapsed_s: float, ohm: Floats) -> float:
    """Return the terminal voltage after ``elapsed_s`` of the constant current [V].

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        current_a: Current from now on [A].
        elapsed_s: Time from now [s]; 0: directly after the current step.
        ohm: Scratch space of shape (RESISTANCES,); contains the resistances at the end.
    """
    soc = s.mean[q, SOC] - current_a * elapsed_s / hypothesis_capacity(s, p, q)
    scaled_resistances(s, p, q, soc, ohm)
    voltage_v = open_circuit_voltage(s, p, q, soc, elapsed_s) - ohm[0] * current_a
    for k in range(BRANCHES):
        voltage_v -= ohm[1 + k] * branch_current(s, q, k, current_a, elapsed_s)
    return voltage_v
