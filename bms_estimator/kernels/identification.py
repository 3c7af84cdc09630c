"""The identifier at work beside the observer: its SOC, its elements gathered in the map, the fit handed to (3.18).

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
"""

import math

from numba import njit

from bms_estimator.kernels.charge import UNMEASURED_S
from bms_estimator.kernels.element_map import CAPACITANCES, ELEMENTS, age, fit_element, fit_within, learn
from bms_estimator.kernels.identifier import identifier_init, identifier_step, soc
from bms_estimator.kernels.identifier_state import LN_R_S, LN_R_TL, LN_R_TS, LN_TAU_TL, LN_TAU_TS, SOC
from bms_estimator.kernels.margins import delta
from bms_estimator.kernels.state import Record

FIT_EVERY_S = 10.0
"""One element is fitted this often, each in its turn [s of samples]."""
LEAST_BINS = 3
"""Three parameters of an element need so many bins of SOC."""


@njit(cache=True)
def start_identifier(s: Record, p: Record, current_a: float, voltage_v: float) -> None:
    """Begin at the SOC of the observer's first sample."""
    identifier_init(s.identifier, p.identifier)
    s.identifier.mean[SOC] = s.identifier.good_mean[SOC] = s.observer.soc
    identifier_step(s.identifier, p.identifier, 0.0, current_a, voltage_v)


@njit(cache=True)
def identify(s: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> None:
    """Take one sample: SOC for the observer, elements for the map, every now and then a fit for (3.18)."""
    identifier_step(s.identifier, p.identifier, dt_s, current_a, voltage_v)
    s.observer.soc = soc(s.identifier)
    if dt_s <= UNMEASURED_S:
        learn_elements(s, dt_s)
    s.fit_age_s += dt_s
    if s.fit_age_s >= FIT_EVERY_S:
        e = s.next_element
        for row in range(ELEMENTS):
            age(s.map, row, math.exp(-s.fit_age_s / p.map_memory_s))
        fit_element(s.map, e, p.configured, s.fit)
        hand_over(s, p, e)
        s.next_element = (e + 1) % ELEMENTS
        s.fit_age_s = 0.0


@njit(cache=True)
def learn_elements(s: Record, dt_s: float) -> None:
    """Add the present elements to the map, in its order R_ts, R_tl, C_ts, C_tl, R_s."""
    x, cov, now = s.identifier.mean, s.identifier.covariance, s.observer.soc
    learn_one(s, 0, now, x[LN_R_TS], cov[LN_R_TS, LN_R_TS], dt_s)
    learn_one(s, 1, now, x[LN_R_TL], cov[LN_R_TL, LN_R_TL], dt_s)
    variance = cov[LN_TAU_TS, LN_TAU_TS] + cov[LN_R_TS, LN_R_TS] - 2.0 * cov[LN_TAU_TS, LN_R_TS]
    learn_one(s, 2, now, x[LN_TAU_TS] - x[LN_R_TS], variance, dt_s)
    variance = cov[LN_TAU_TL, LN_TAU_TL] + cov[LN_R_TL, LN_R_TL] - 2.0 * cov[LN_TAU_TL, LN_R_TL]
    learn_one(s, 3, now, x[LN_TAU_TL] - x[LN_R_TL], variance, dt_s)
    learn_one(s, 4, now, x[LN_R_S], cov[LN_R_S, LN_R_S], dt_s)


@njit(cache=True)
def learn_one(s: Record, e: int, now: float, ln_value: float, variance: float, dt_s: float) -> None:
    """Add one element, and note when that was."""
    learned = learn(s.map, e, now, ln_value, variance, dt_s)
    s.unlearned_s[e] = 0.0 if learned else s.unlearned_s[e] + dt_s


@njit(cache=True)
def hand_over(s: Record, p: Record, e: int) -> None:
    """Let the fitted parameters of an element be where (3.18) leads, within the configured bounds.

    By Lemma 4.1.3 the limit is all that (3.18) takes of its bounds: it is set, in place of two bounds around it.
    Parameters that no law adapts (a13..a15 of the improved method) take the fitted values at once.
    A capacitance that is negative at the present SOC is no limit to strive for: it would end the adaptation (E14).
    """
    if p.hand_over == 0 or s.fit.bins[e] < LEAST_BINS:
        return
    i = 3 * e + 1
    amplitude, exponent, offset = fit_within(s.fit, e, p.lower, p.upper)
    if e in CAPACITANCES and delta(exponent, offset, amplitude) + p.observer.margin_guard >= s.observer.soc:
        return
    aim(s.observer, p.observer, i, amplitude)
    aim(s.observer, p.observer, i + 1, exponent)
    aim(s.observer, p.observer, i + 2, offset)


@njit(cache=True)
def aim(s: Record, p: Record, i: int, value: float) -> None:
    """Let ``value`` be the limit of a_i, of the observer's records."""
    s.target[i] = value
    if p.drive[i] == 0.0:
        s.a[i] = value
