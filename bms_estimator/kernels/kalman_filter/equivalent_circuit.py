"""The two branches of (2.2)-(2.3) that the ladder of the filter amounts to, here and now, with their errors.

Branches up to ``SHORT_S`` make R_ts, the slower ones R_tl: resistances in series add, and the time constant is the
geometric mean weighted by resistance.

``f`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS, ``e`` of EQUIVALENT.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    REFERENCE_C,
    RESISTANCES,
    TAU_S,
    TAUS,
    on_grid,
    resistances,
)
from bms_estimator.kernels.kalman_filter.noise import resistance_std
from bms_estimator.kernels.kalman_filter.ocv_correction import ocv_correction
from bms_estimator.kernels.kalman_filter.records import HYST, LN_R, LN_R0, OFFSET, SOC, X
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

R_S, R_TS, TAU_TS, C_TS, R_TL, TAU_TL, C_TL = range(7)
"""Indices into ``value`` and ``ln_variance``."""
SHORT_S = 60.0
"""Limit between the time constants published as R_ts C_ts and as R_tl C_tl [s]."""
SHORT = sum(tau_s < SHORT_S for tau_s in TAU_S)
SHAPE_STD = 0.03
"""Relative std of the file's series resistance, scaled to the cell, at one SOC and temperature."""
MAX_S = 2.0
"""Samples further apart show no step of the current [s]."""
KNOWN = 0.5
"""A scale of the resistances was identified when its variance is below this part of the first one."""
LN_TAUS = np.log(np.array(TAU_S))

EQUIVALENT = np.dtype(
    [
        ("ohm", "f8", RESISTANCES),  # of the ladder, as the filter has scaled them
        ("value", "f8", 7),  # R_s, R_ts [ohm], tau_ts [s], C_ts [F], R_tl, tau_tl, C_tl
        ("ln_variance", "f8", 7),  # of their logarithms
    ],
    align=True,
)


@njit(cache=True)
def equivalent(f: Record, p: Record, e: Record) -> None:
    """Resistances and two branches at SOC and temperature of the likeliest filter into ``e``."""
    x, cov = f.mean[f.best], f.covariance[f.best]
    resistances(x[SOC], p.weak_ohm, p.strong_ohm, f.weak, f.strong, e.ohm)
    file_ohm, others = e.ohm[0], math.exp(x[LN_R])
    e.ohm[0] *= math.exp(x[LN_R0])
    for k in range(1, RESISTANCES):
        e.ohm[k] *= others
    ratio, variance = ln_r_s_ratio(f, p)
    half_ohm = 0.5 * branch_rise_within_sample(f, e)
    e.value[R_S] = file_ohm * math.exp(ratio) + half_ohm
    e.ln_variance[R_S] = variance + (half_ohm / e.value[R_S]) ** 2
    one_branch(e, 0, SHORT, R_TS, cov[LN_R, LN_R], p.r_std)
    one_branch(e, SHORT, BRANCHES, R_TL, cov[LN_R, LN_R], p.r_std)


@njit(cache=True)
def ln_r_s_ratio(f: Record, p: Record) -> tuple[float, float]:
    """Ln of R_s over R_0 of the file at the same SOC and temperature, and its variance: by steps, else as the filter has it."""
    if r_s_identified_by_steps(f, p):
        return f.step.ln_ratio, f.step.variance + SHAPE_STD**2
    return f.mean[f.best, LN_R0], f.covariance[f.best, LN_R0, LN_R0] + SHAPE_STD**2


@njit(cache=True)
def one_branch(e: Record, first: int, end: int, at: int, scale_variance: float, r_std: float) -> None:
    """R, tau and C of branches ``first`` to before ``end`` into ``e.value[at : at + 3]``.

    All have one scale of variance ``scale_variance``; beside it each is wrong by ``r_std`` on its own, which errs in tau.
    """
    ohm = ln_tau = 0.0
    for k in range(first, end):
        ohm += e.ohm[1 + k]
        ln_tau += e.ohm[1 + k] * LN_TAUS[k]
    ln_tau /= ohm
    by_r = by_tau = by_c = 0.0
    for k in range(first, end):
        share, apart = e.ohm[1 + k] / ohm, LN_TAUS[k] - ln_tau
        by_r += share**2
        by_tau += (share * apart) ** 2
        by_c += (share * (apart - 1.0)) ** 2
    own = r_std * r_std
    e.value[at], e.ln_variance[at] = ohm, scale_variance + own * by_r
    e.value[at + 1], e.ln_variance[at + 1] = math.exp(ln_tau), own * by_tau
    e.value[at + 2], e.ln_variance[at + 2] = math.exp(ln_tau) / ohm, scale_variance + own * by_c


@njit(cache=True)
def branch_rise_within_sample(f: Record, e: Record) -> float:
    """Return the rise of the branches within one sample after a step [ohm]. How much of it is R_s cannot be observed."""
    ohm = 0.0
    for k in range(BRANCHES):
        ohm += e.ohm[1 + k] * (1.0 - math.exp(-min(f.decay_s, MAX_S) / TAUS[k]))
    return ohm


@njit(cache=True)
def scale_is_identified(f: Record, p: Record, j: int) -> bool:
    """Return True if data have determined the scale LN_R0 or LN_R, ``j``."""
    return f.covariance[f.best, j, j] < KNOWN * resistance_std(f, p) ** 2


@njit(cache=True)
def r_s_identified_by_steps(f: Record, p: Record) -> bool:
    """Return True if steps of the current have determined R_s."""
    return f.step.variance < KNOWN * resistance_std(f, p) ** 2


@njit(cache=True)
def open_circuit(f: Record, p: Record, e: Record, current_a: float, voltage_v: float) -> float:
    """Voltage less overpotential, hysteresis and what temperature does to the OCV: E_o of the cell file's curve, at 25 C [V], (2.4)."""
    x = f.mean[f.best]
    e_o = voltage_v + e.ohm[0] * (current_a - x[OFFSET])
    for k in range(BRANCHES):
        e_o += e.ohm[1 + k] * (f.x_a[k] + x[X + k])
    e_o -= f.hysteresis * on_grid(x[SOC], p.hysteresis_v) * x[HYST] + ocv_correction(p, x, x[SOC])
    return e_o - (f.temperature_c - REFERENCE_C) * on_grid(x[SOC], p.per_kelvin_v)
