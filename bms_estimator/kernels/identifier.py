"""Identifier: one sample updates the Kalman filter, the map of elements over SOC, and the targets of the adaptive law.

The adaptive law is (3.18) of the thesis. Errata are listed in docs/theory/thesis.md.

The map also gives the stability margin of thesis 2.1.2, which is SOC minus max(delta1, delta2). delta1 (2.11) and delta2 (2.12)
follow from a7..a12, the parameters of C_ts and C_tl. Before data have determined these parameters, delta1 and delta2 are a
property of the cell file's formula, and there is no margin.

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
"""

import math

from bms_estimator.kernels.accumulators.history import add_reference, add_window, begin_segment
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.kernels.kalman_filter.anchors import (
    EMPTY,
    FULL,
    NO_ANCHOR,
    apply_anchor,
    detect_anchor,
    gap_begins_empty,
)
from bms_estimator.kernels.kalman_filter.element_map import (
    CAPACITANCES,
    ELEMENTS,
    add_observation,
    decay_weights,
    fit_element,
    fit_within,
)
from bms_estimator.kernels.kalman_filter.equivalent_circuit import (
    C_TL,
    C_TS,
    R_S,
    R_TL,
    R_TS,
    VARYING,
    detect_current_step,
    r_s_identified_by_steps,
    scale_is_identified,
    write_equivalent_circuit,
)
from bms_estimator.kernels.kalman_filter.frozen_sensor import detect_frozen_input
from bms_estimator.kernels.kalman_filter.hypotheses import (
    MAX_STD_OF_ONE_HYPOTHESIS,
    update_hypotheses,
    weakest_cell_soc_std,
)
from bms_estimator.kernels.kalman_filter.input_checks import (
    UNUSABLE,
    coast_without_voltage,
    passes_innovation_gate,
    restore_if_not_finite,
    store_last_good_state,
    track_current_sign,
    update_input_faults,
)
from bms_estimator.kernels.kalman_filter.records import LN_R, LN_R0
from bms_estimator.kernels.kalman_filter.window import WINDOW_S, add_to_window, integrate_current
from bms_estimator.kernels.start import restart_filter
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

FIT_EVERY_S = 120.0
"""Interval at which the next of the five elements is fitted, in sample time [s]."""
MIN_BINS = 3
"""Minimum number of SOC bins for a fit of an element's three parameters."""
LONG_GAP = 2
"""Value of ``window.gap`` after a gap in which the pack may have been charged or exchanged."""
MIN_EXCITATION_C = 0.05
"""Minimum load that excites the resistances, as a C-rate, RMS over 10 min."""
VALID_FIT_STD = 0.5
"""Maximum relative std of a valid a1..a15. Amplitudes and exponents can be separated only after a sweep of the SOC."""
VALID_STD = 0.3
"""Maximum relative std of a valid circuit element, and of the resistances of the RC ladder for a valid time constant."""


@njit(cache=True)
def identifier_step(
    s: Record, p: Record, dt_s: float, gap: bool, current_a: float, voltage_v: float, temperature_c: float
) -> None:
    """Process one sample: update SOC, map of elements and, at intervals, the targets of (3.18).

    Args:
        s: Record of ESTIMATOR_STATE.
        p: Record of ESTIMATOR_SETTINGS.
        dt_s: Time since the previous sample [s].
        gap: True if samples are missing since the previous sample.
        current_a: Current, positive on discharge [A].
        voltage_v: Terminal voltage [V]; NaN if it was not measured at this sample.
        temperature_c: Temperature of the cell [C]; NaN without a sensor.
    """
    f, c, measured = s.filter, s.checks, math.isfinite(voltage_v)
    change_a = current_a - f.current_a
    if gap and f.window.samples > 0:
        update_from_window(s, p)  # measurements before the gap give no information on the charge in it
    if gap and not c.suspects & UNUSABLE and gap_begins_empty(s.anchors, dt_s):
        correct_at_anchor(s, p, EMPTY)
    integrate_current(f, p.filter, dt_s, gap, current_a, temperature_c)
    if dt_s > p.filter.unmeasured_s:  # the current between the samples is unknown
        s.unlearned_s[:] += dt_s
    unknown_soc = f.window.unknown_as / p.filter.capacity_as
    if gap and dt_s >= p.filter.unmeasured_s:
        f.window.gap = LONG_GAP
    may_hide_charge = f.window.gap == LONG_GAP or (f.window.gap and unknown_soc > MAX_STD_OF_ONE_HYPOTHESIS)
    # the SOC after such a gap needs a voltage: if the gap ended without one, the filter restarts at the first voltage after it
    if measured and may_hide_charge and not c.suspects & UNUSABLE:
        restart_filter(s, p, f.window.time_s, current_a, voltage_v)
        s.fit_age_s += dt_s
        return
    accepted = measured and accept_voltage(s, p, current_a, voltage_v, change_a)
    if c.suspects & UNUSABLE:
        coast(s, p, dt_s, current_a)
    elif accepted:
        detect_current_step(f, p.filter, s.observer.voltage_age_s, change_a, voltage_v)
        add_to_window(f, current_a, voltage_v)
    else:
        f.step.phase = VARYING  # without the voltage, the current step determines no R_s
    if f.window.time_s >= WINDOW_S and f.window.samples > 0:
        update_from_window(s, p)
    s.observer.soc = f.soc
    s.fit_age_s += dt_s
    if s.fit_age_s >= FIT_EVERY_S:
        fit_next_element(s, p)


@njit(cache=True)
def coast(s: Record, p: Record, dt_s: float, current_a: float) -> None:
    """Process a sample without its voltage. For the history, the time of the fault is a gap."""
    f, c = s.filter, s.checks
    fault_s, charge_as, soc_std = f.window.time_s, f.window.charge_as, f.soc_std
    coast_without_voltage(c, f, p.filter, dt_s, current_a)
    if not c.suspects & UNUSABLE:  # the fault has just ended
        begin_segment(s.history, fault_s, charge_as, soc_std * p.filter.capacity_as)


@njit(cache=True)
def accept_voltage(s: Record, p: Record, current_a: float, voltage_v: float, change_a: float) -> bool:
    """Run the input checks with a measured voltage; return True if the filter may use the voltage.

    The checks compare successive measured voltages. They run during a fault, too, because they detect its end.
    """
    c, f, dt_s = s.checks, s.filter, s.observer.voltage_age_s
    usable = detect_frozen_input(c, f, p.filter, dt_s, current_a, voltage_v)
    track_current_sign(c, p.filter, dt_s, current_a, voltage_v)
    if c.suspects & UNUSABLE or not usable:
        return False
    return passes_innovation_gate(c, s.counters, f, p.filter, s.elements, dt_s, change_a, current_a, voltage_v)


@njit(cache=True)
def update_from_window(s: Record, p: Record) -> None:
    """Update the filter, the input checks, the elements and the map with the samples of the window."""
    f, c = s.filter, s.checks
    dt_s = f.window.time_s
    c.mean_a = f.window.sum_a / f.window.samples
    add_window(s.history, f, p.filter)
    voltage_v = f.window.sum_v / f.window.samples
    update_hypotheses(f, p.filter)
    kind = detect_anchor(s.anchors, p.anchors, f, p.filter, dt_s, c.mean_a, voltage_v)
    if kind != NO_ANCHOR:
        correct_at_anchor(s, p, kind)
    restore_if_not_finite(c, s.counters, f, p.filter, dt_s)
    update_input_faults(c, f, p.filter, dt_s)
    write_equivalent_circuit(f, p.filter, s.elements)
    if dt_s <= p.filter.unmeasured_s:
        add_elements_to_map(s, p, dt_s)


@njit(cache=True)
def correct_at_anchor(s: Record, p: Record, kind: int) -> None:
    """Correct the SOC at the end of a charge (``FULL``) or of a discharge (``EMPTY``)."""
    f, c, a = s.filter, s.checks, s.anchors
    if kind == FULL:
        add_reference(s.history, kind, 1.0, a.full_std)
    else:
        add_reference(s.history, kind, 0.0, a.empty_std)
    a.last, a.soc_before, a.soc_std_before = kind, f.soc, weakest_cell_soc_std(f, p.filter)
    if kind == FULL and p.anchors.corrects_full:
        apply_anchor(f, p.filter, 1.0, a.full_std)
    elif kind == EMPTY and p.anchors.corrects_empty:
        apply_anchor(f, p.filter, 0.0, a.empty_std)
    a.soc_after = f.soc
    if not c.suspects & UNUSABLE:
        # 0 means no previous voltage: a sensor that freezes now must not restore the SOC from before the anchor
        c.last_v = 0.0
    store_last_good_state(c, f)


@njit(cache=True)
def fit_next_element(s: Record, p: Record) -> None:
    """Fit the next element to the map and set its targets."""
    e = s.next_element
    for row in range(ELEMENTS):
        decay_weights(s.map, row, math.exp(-s.fit_age_s / p.map_memory_s))
    fit_element(s.map, e, p.configured, s.fit)
    set_adaptation_targets(s, p, e)
    s.next_element = (e + 1) % ELEMENTS
    s.fit_age_s = 0.0


@njit(cache=True)
def add_elements_to_map(s: Record, p: Record, dt_s: float) -> None:
    """Add the present elements to the map if the load excites them, in the order R_ts, R_tl, C_ts, C_tl, R_s."""
    f = s.filter
    exciting_a = MIN_EXCITATION_C * p.filter.capacity_as / 3600.0
    loaded = f.rms_a2 > exciting_a * exciting_a
    pairs_identified = loaded and scale_is_identified(f, p.filter, LN_R)
    r_s_identified = loaded and (r_s_identified_by_steps(f, p.filter) or scale_is_identified(f, p.filter, LN_R0))
    # the second argument is the row of the map, an index of ELEMENT_NAMES
    add_element_to_map(s, 0, R_TS, pairs_identified, dt_s)
    add_element_to_map(s, 1, R_TL, pairs_identified, dt_s)
    add_element_to_map(s, 2, C_TS, pairs_identified, dt_s)
    add_element_to_map(s, 3, C_TL, pairs_identified, dt_s)
    add_element_to_map(s, 4, R_S, r_s_identified, dt_s)


@njit(cache=True)
def add_element_to_map(s: Record, row: int, j: int, identified: bool, dt_s: float) -> None:
    """Add one element to the map if it is identified, and update the age of its data.

    Args:
        s: Record of ESTIMATOR_STATE.
        row: Row of the map.
        j: Index of the element in ``s.elements``.
        identified: True if the present data determine the element.
        dt_s: Time since the last update [s].
    """
    learned = identified and add_observation(
        s.map, row, s.filter.soc, math.log(s.elements.value[j]), s.elements.ln_variance[j], dt_s
    )
    s.unlearned_s[row] = 0.0 if learned else s.unlearned_s[row] + dt_s


@njit(cache=True)
def set_adaptation_targets(s: Record, p: Record, e: int) -> None:
    """Set the fitted parameters of an element, within the configured bounds, as limits of (3.18).

    ``e`` is the row of the map. (3.18) depends on its bounds only through the limit to which a parameter converges (Lemma 4.1.3
    of the thesis), so that the limit is set and not the bounds. Parameters that no law adapts, a13..a15 of R_s with
    ``law = "improved"``, get the fitted values at once. A capacitance that is negative at the present SOC is not set, because it
    would end the adaptation (erratum 14).
    """
    if p.sets_targets == 0 or s.fit.bins[e] < MIN_BINS:
        return
    i = 3 * e + 1  # index of the amplitude: a1, a4, a7, a10 or a13
    amplitude, exponent, offset = fit_within(s.fit, e, p.lower, p.upper)
    # the capacitance is negative below the SOC delta
    if e in CAPACITANCES and delta(exponent, offset, amplitude) + p.observer.margin_guard >= s.observer.soc:
        return
    set_target(s.observer, p.observer, i, amplitude)
    set_target(s.observer, p.observer, i + 1, exponent)
    set_target(s.observer, p.observer, i + 2, offset)


@njit(cache=True)
def set_target(s: Record, p: Record, i: int, value: float) -> None:
    """Set ``value`` as the limit of a_i, and as a_i itself if no law adapts a_i.

    ``s`` is a record of OBSERVER_STATE, ``p`` of OBSERVER_SETTINGS.
    """
    s.target[i] = value
    if p.drive[i] == 0.0:
        s.a[i] = value


@njit(cache=True)
def margin_with_std(s: Record, p: Record, soc_std: float) -> tuple[float, float]:
    """Return the stability margin and its std, both NaN unless max(delta1, delta2) is above 0 and a7..a12 are valid.

    a7..a12 are valid under the conditions of the payload ``parameters``. ``soc_std`` is the std of the SOC.
    """
    o = s.observer
    e = CAPACITANCES[0] if o.delta_1 >= o.delta_2 else CAPACITANCES[1]
    limit, limit_std = max(o.delta_1, o.delta_2), s.fit.delta_std[e]
    # ``limit_std`` is 0 from a checkpoint of an earlier version until the next fit
    is_identified = p.identify and not p.learning.enabled and p.filter.r_std < VALID_STD and limit_std > 0.0
    if not (limit > 0.0 and is_identified and has_valid_parameters(s, p, 2) and has_valid_parameters(s, p, 3)):
        return math.nan, math.nan
    i = 3 * e + 1
    # the observer's parameters differ from the fit while they converge, and if a bound limits them
    difference = delta(s.fit.a[i + 1], s.fit.a[i + 2], s.fit.a[i]) - limit
    return o.soc - limit, math.sqrt(soc_std * soc_std + limit_std * limit_std + difference * difference)


@njit(cache=True)
def has_valid_parameters(s: Record, p: Record, e: int) -> bool:
    """Return True if data have determined the three parameters of element ``e``, an index of ``ELEMENT_NAMES``."""
    o, fit = s.observer, s.fit
    if fit.bins[e] < MIN_BINS or not math.isfinite(s.unlearned_s[e]):
        return False
    for i in range(3 * e + 1, 3 * e + 4):
        std = math.sqrt(fit.std[i] ** 2 + (fit.a[i] - o.a[i]) ** 2)
        if o.target[i] == p.observer.target[i] or not std < VALID_FIT_STD * abs(o.a[i]):
            return False
    return True


@njit(cache=True)
def is_delta_configured(s: Record, p: Record) -> bool:
    """Return True if no data have changed delta1 and delta2. False for a fuel cell, which has neither.

    The identifier changes the limits of a7..a12. The learning law changes only the scale of C_ts and C_tl.
    """
    o = s.observer
    for i in range(3 * CAPACITANCES[0] + 1, 3 * CAPACITANCES[1] + 4):
        if o.target[i] != p.observer.target[i]:
            return False
    return not math.isnan(o.delta_1)
