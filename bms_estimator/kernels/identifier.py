"""The identifier: SOC, branch voltages and the local elements from one sample to the next, with their covariance.

An iterated extended Kalman filter on (2.1)-(2.4) with the logarithms of R_s, R_ts, tau_ts, R_tl, tau_tl as states, so
that every element is positive. What the model cannot know is a state or a noise of its own:

- The OCV curve is another cell's. Its error is a Gauss-Markov process over SOC, not over time: standing still at one
  SOC teaches nothing more about it, and so the SOC is never more certain than the curve allows.
- Two branches are not diffusion. Each branch has a process noise that follows the load, and a voltage error that keeps
  its sign for seconds, so that a thousand samples a second know no more than one. How large these are is learned
  from the innovations: a cell that is two branches is identified to a per cent, a real one not believed too much.
- Elements change with SOC and temperature: their variance grows with charge moved, and with time as far as the load
  makes them visible. It grows faster while the innovations surprise (near empty).

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS. No allocation, no clock. Joseph form, symmetric.
"""

import math

from numba import njit

from bms_estimator.kernels.identifier_correction import correct
from bms_estimator.kernels.identifier_guard import clear, constrain, guard, keep
from bms_estimator.kernels.identifier_prediction import predict
from bms_estimator.kernels.identifier_state import (
    LN_R_S,
    LN_R_TL,
    LN_R_TS,
    LN_TAU_TL,
    LN_TAU_TS,
    SOC,
    STATES,
    V_SLOW,
    V_TL,
    V_TS,
)
from bms_estimator.kernels.identifier_suspicion import SIGN_OF_CURRENT, watch
from bms_estimator.kernels.state import Record

Elements = tuple[float, float, float, float, float, float, float]
"""R_s, R_ts, tau_ts, C_ts, R_tl, tau_tl, C_tl."""

FIRST_SAMPLE_S = 1.0
"""The first sample counts as one after a second."""
SHORTEST_STEP_S = 1e-6


@njit(cache=True)
def identifier_init(s: Record, p: Record) -> None:
    """Start again from the settings; counters are kept."""
    for j in range(STATES):
        s.mean[j] = p.mean[j]
        for k in range(STATES):
            s.covariance[j, k] = 0.0
        s.covariance[j, j] = p.variance[j]
    clear(s)
    s.branch = 0.0
    s.gated_in_row = 0
    s.gated_s = 0.0
    s.started = 0
    keep(s)


@njit(cache=True)
def identifier_step(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take one sample.

    Args:
        s: Record of IDENTIFIER_STATE; updated in place.
        p: Record of IDENTIFIER_SETTINGS.
        dt_s: Time since the sample before [s]; any at the first one. A sample that is not later is ignored.
        current_a: Current [A], positive on discharge.
        voltage_v: Terminal voltage [V].
    """
    if not (math.isfinite(dt_s) and math.isfinite(current_a) and math.isfinite(voltage_v)):
        s.ignored += 1
        return
    if s.started == 0:
        start(s, p, current_a)
        dt_s = FIRST_SAMPLE_S
    elif dt_s < SHORTEST_STEP_S:
        s.ignored += 1
        return
    else:
        predict(s, p, dt_s, current_a)
    correct(s, p, dt_s, current_a, voltage_v)
    constrain(s, p)
    s.current_a = current_a
    guard(s, p, dt_s)
    before = s.suspects
    watch(s, p, dt_s, current_a, voltage_v)
    if before & SIGN_OF_CURRENT and not s.suspects & SIGN_OF_CURRENT:
        forget(s, p, current_a)


@njit(cache=True)
def forget(s: Record, p: Record, current_a: float) -> None:
    """The current has its right sign again: what was learned under the wrong one is worth nothing."""
    last = s.mean[SOC]
    identifier_init(s, p)
    s.mean[SOC] = s.good_mean[SOC] = last
    start(s, p, current_a)


@njit(cache=True)
def start(s: Record, p: Record, current_a: float) -> None:
    """First sample: under load the branches may stand anywhere up to R i."""
    s.started = 1
    s.current_a = current_a
    s.covariance[V_TS, V_TS] = p.variance[V_TS] + (math.exp(s.mean[LN_R_TS]) * current_a) ** 2
    s.covariance[V_TL, V_TL] = p.variance[V_TL] + (math.exp(s.mean[LN_R_TL]) * current_a) ** 2
    s.covariance[V_SLOW, V_SLOW] = (p.slow_mean * (math.exp(s.mean[LN_R_TL]) * current_a)) ** 2


@njit(cache=True)
def soc(s: Record) -> float:
    """State of charge, 0..1."""
    return min(max(s.mean[SOC], 0.0), 1.0)


@njit(cache=True)
def soc_std(s: Record) -> float:
    """Standard deviation of the state of charge."""
    return math.sqrt(s.covariance[SOC, SOC])


@njit(cache=True)
def element_values(s: Record) -> Elements:
    """R_s [ohm], R_ts [ohm], tau_ts [s], C_ts [F], R_tl [ohm], tau_tl [s], C_tl [F] at the present SOC."""
    x = s.mean
    ohm_ts, tau_ts = math.exp(x[LN_R_TS]), math.exp(x[LN_TAU_TS])
    ohm_tl, tau_tl = math.exp(x[LN_R_TL]), math.exp(x[LN_TAU_TL])
    return math.exp(x[LN_R_S]), ohm_ts, tau_ts, tau_ts / ohm_ts, ohm_tl, tau_tl, tau_tl / ohm_tl


@njit(cache=True)
def element_ln_stds(s: Record) -> Elements:
    """Relative standard deviations (of the logarithms), in the order of ``element_values``."""
    cov = s.covariance
    return (
        math.sqrt(cov[LN_R_S, LN_R_S]),
        math.sqrt(cov[LN_R_TS, LN_R_TS]),
        math.sqrt(cov[LN_TAU_TS, LN_TAU_TS]),
        _ratio_std(s, LN_TAU_TS, LN_R_TS),
        math.sqrt(cov[LN_R_TL, LN_R_TL]),
        math.sqrt(cov[LN_TAU_TL, LN_TAU_TL]),
        _ratio_std(s, LN_TAU_TL, LN_R_TL),
    )


@njit(cache=True)
def _ratio_std(s: Record, j: int, k: int) -> float:
    """Standard deviation of x[j] - x[k]."""
    return math.sqrt(max(s.covariance[j, j] + s.covariance[k, k] - 2.0 * s.covariance[j, k], 0.0))
