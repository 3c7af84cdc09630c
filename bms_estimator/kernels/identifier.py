"""The filter at work beside the observer: its SOC, its elements gathered in the map, the fit handed to (3.18).

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.kernels.kalman_filter.ekf import predict
from bms_estimator.kernels.kalman_filter.element_map import CAPACITANCES, ELEMENTS, age, fit_element, fit_within, learn
from bms_estimator.kernels.kalman_filter.equivalent_circuit import (
    C_TL,
    C_TS,
    R_S,
    R_TL,
    R_TS,
    equivalent,
    told,
    told_by_steps,
)
from bms_estimator.kernels.kalman_filter.frozen_sensor import watch_frozen
from bms_estimator.kernels.kalman_filter.hypotheses import ONE_STD, update_all
from bms_estimator.kernels.kalman_filter.input_checks import UNUSABLE, believed, guard, judge, wait, watch_sign
from bms_estimator.kernels.kalman_filter.records import LN_R, LN_R0
from bms_estimator.kernels.kalman_filter.step_resistance import UNHELD, watch_steps
from bms_estimator.kernels.kalman_filter.window import WINDOW_S, count_on, gather, pass_time
from bms_estimator.kernels.start import restart_filter
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

FIT_EVERY_S = 120.0
"""One element is fitted this often, each in its turn [s of samples]."""
LEAST_BINS = 3
"""Three parameters of an element need so many bins of SOC."""
EXCITING_C = 0.05
"""A load of so much, RMS over 10 min, tells of the resistances [C]."""


@njit(cache=True)
def identify(
    s: Record, p: Record, dt_s: float, gap: bool, current_a: float, voltage_v: float, temperature_c: float
) -> None:
    """Take one sample, after a ``gap`` or not: SOC for the observer, elements for the map, now and then a fit for (3.18)."""
    f, c = s.filter, s.checks
    change_a = current_a - f.current_a
    if gap and f.window.samples > 0:
        take_window(s, p)  # what was measured before tells nothing of what flowed in the gap
    count_on(f, p.filter, dt_s, gap, current_a, temperature_c)
    if dt_s > p.filter.unmeasured_s:
        s.unlearned_s[:] += dt_s
    unknown = f.window.unknown_as / p.filter.capacity_as
    if gap and unknown > ONE_STD and not c.suspects & UNUSABLE:
        pass_time(f, p.filter)
        predict(f, p.filter, f.best)
        restart_filter(s, p, math.hypot(f.soc_std, unknown), current_a, voltage_v)
        s.fit_age_s += dt_s
        return
    sound = watch_frozen(c, f, p.filter, dt_s, current_a, voltage_v)
    watch_sign(c, p.filter, dt_s, current_a, voltage_v)
    if c.suspects & UNUSABLE:
        wait(c, f, p.filter, dt_s, current_a)
    elif sound and believed(c, s.counters, f, p.filter, s.elements, dt_s, change_a, current_a, voltage_v):
        watch_steps(f, p.filter, dt_s, change_a, voltage_v)
        gather(f, current_a, voltage_v)
    else:
        f.step.phase = UNHELD
    if f.window.time_s >= WINDOW_S and f.window.samples > 0:
        take_window(s, p)
    s.observer.soc = f.soc
    s.fit_age_s += dt_s
    if s.fit_age_s >= FIT_EVERY_S:
        fit_next(s, p)


@njit(cache=True)
def take_window(s: Record, p: Record) -> None:
    """One update of the filter, and what follows from it."""
    f, c = s.filter, s.checks
    dt_s = f.window.time_s
    c.mean_a = f.window.sum_a / f.window.samples
    update_all(f, p.filter)
    guard(c, s.counters, f, p.filter, dt_s)
    judge(c, f, p.filter, dt_s)
    equivalent(f, p.filter, s.elements)
    if dt_s <= p.filter.unmeasured_s:
        learn_elements(s, p, dt_s)


@njit(cache=True)
def fit_next(s: Record, p: Record) -> None:
    """Fit one element to the map, each in its turn."""
    e = s.next_element
    for row in range(ELEMENTS):
        age(s.map, row, math.exp(-s.fit_age_s / p.map_memory_s))
    fit_element(s.map, e, p.configured, s.fit)
    hand_over(s, p, e)
    s.next_element = (e + 1) % ELEMENTS
    s.fit_age_s = 0.0


@njit(cache=True)
def learn_elements(s: Record, p: Record, dt_s: float) -> None:
    """Add the present elements to the map, in its order R_ts, R_tl, C_ts, C_tl, R_s, where the load told of them."""
    f = s.filter
    exciting_a = EXCITING_C * p.filter.capacity_as / 3600.0
    loaded = f.rms_a2 > exciting_a * exciting_a
    branches = loaded and told(f, p.filter, LN_R)
    learn_one(s, 0, R_TS, branches, dt_s)
    learn_one(s, 1, R_TL, branches, dt_s)
    learn_one(s, 2, C_TS, branches, dt_s)
    learn_one(s, 3, C_TL, branches, dt_s)
    learn_one(s, 4, R_S, loaded and (told_by_steps(f, p.filter) or told(f, p.filter, LN_R0)), dt_s)


@njit(cache=True)
def learn_one(s: Record, e: int, j: int, is_told: bool, dt_s: float) -> None:
    """Add one element, ``j`` of the equivalent ones, and note when that was."""
    learned = is_told and learn(s.map, e, s.filter.soc, math.log(s.elements.value[j]), s.elements.ln_variance[j], dt_s)
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
