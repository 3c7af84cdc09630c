"""Processing of the first sample, and of the first one after a restart.

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
"""

import math

from bms_estimator.kernels.accumulators.history import begin_segment
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.kernels.kalman_filter.anchors import continue_over_gap
from bms_estimator.kernels.kalman_filter.ekf import predict
from bms_estimator.kernels.kalman_filter.equivalent_circuit import (
    VARYING,
    write_equivalent_circuit,
)
from bms_estimator.kernels.kalman_filter.hypotheses import (
    begin_gap,
    forget_state_of_charge,
    initialize_filter,
    set_initial_soc,
    spawn_after_gap,
    spawn_hypotheses,
    update_hypotheses,
)
from bms_estimator.kernels.kalman_filter.input_checks import UNUSABLE, store_last_good_state
from bms_estimator.kernels.kalman_filter.mixture import copy_hypothesis, limit_soc_std, merge_all
from bms_estimator.kernels.kalman_filter.window import (
    add_to_window,
    is_resting,
    prepare_transition,
    reset_window,
    update_arrhenius_factors,
)
from bms_estimator.kernels.observer.learning_law import initialize_learning, initialize_states_at_rest
from bms_estimator.kernels.observer.series_resistance import (
    initialize_series_resistance,
)
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

MAX_SOC_STD_AFTER_GAP = 0.3
"""Maximum std of the SOC after an unmeasured gap."""
MIN_PLAUSIBLE_C = -60.0
"""Lowest plausible temperature of a cell [C]."""
MAX_PLAUSIBLE_C = 120.0
"""Highest plausible temperature of a cell [C]."""


@njit(cache=True)
def start_filter(s: Record, p: Record, current_a: float, voltage_v: float, temperature_c: float) -> None:
    """Initialize the filter at the observer's initial SOC and update it with the first sample."""
    initialize_filter(s.filter, p.filter, s.observer.soc, current_a, temperature_c)
    s.unlearned_s[:] = math.inf
    first_update(s, p, current_a, voltage_v)


@njit(cache=True)
def restart_filter(s: Record, p: Record, gap_s: float, current_a: float, voltage_v: float) -> None:
    """Re-initialize the SOC after a gap of ``gap_s`` [s]; infinite if unknown. The window contains a gap of known duration."""
    f = s.filter
    begin_segment(s.history, gap_s, f.window.charge_as, f.window.unknown_as)
    f.current_a, f.step.phase = current_a, VARYING
    update_arrhenius_factors(f)
    if gap_s < p.filter.unmeasured_s:  # too short for a charge or an exchange of the pack
        soc_std = math.sqrt(f.soc_std**2 + (f.window.unknown_as / p.filter.capacity_as) ** 2)
        prepare_transition(f, p.filter)
        predict(f, p.filter, f.best)
        spawn_hypotheses(f, p.filter, f.soc, min(soc_std, MAX_SOC_STD_AFTER_GAP))
    else:
        merge_all(f)
        begin_gap(f, p.filter, gap_s)
        rested = is_resting(f, p.filter)
        propagate_over_gap(f, p.filter, gap_s)
        spawn_after_gap(f, p.filter, gap_s, rested)
    reset_window(f)
    continue_over_gap(s.anchors, p.anchors, f, p.filter, gap_s, current_a, voltage_v)
    s.checks.slow_v = 0.0  # no slow means yet
    s.checks.gated_in_row, s.checks.gated_s = 0, 0.0
    if not s.checks.suspects & UNUSABLE:
        s.checks.last_v = 0.0  # no previous sample
        first_update(s, p, current_a, voltage_v)


@njit(cache=True)
def propagate_over_gap(f: Record, p: Record, gap_s: float) -> None:
    """Propagate hypothesis 0 over a gap with the usual load, and hypothesis 1 without a load.

    After a gap of unknown duration, SOC and polarization are unknown. ``f`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
    """
    if gap_s == math.inf:
        f.x_a[:] = 0.0
        forget_state_of_charge(f, p, 0)
        set_initial_soc(f, p, 0, f.soc, MAX_SOC_STD_AFTER_GAP)
        return
    copy_hypothesis(f, 0, 1)
    prepare_transition(f, p)
    predict(f, p, 0)
    limit_soc_std(f, 0, MAX_SOC_STD_AFTER_GAP)
    w = f.window
    w.charge_as = w.throughput_as = w.unknown_as = 0.0
    predict(f, p, 1)


@njit(cache=True)
def first_update(s: Record, p: Record, current_a: float, voltage_v: float) -> None:
    """Update the newly initialized filter with its first sample."""
    f = s.filter
    store_last_good_state(s.checks, f)
    add_to_window(f, current_a, voltage_v)
    s.checks.mean_a = current_a
    update_hypotheses(f, p.filter)
    write_equivalent_circuit(f, p.filter, s.elements)
    s.observer.soc = f.soc


@njit(cache=True)
def initialize_state(s: Record, p: Record, current_a: float, voltage_v: float, temperature_c: float) -> None:
    """Initialize filter, learning law and sums of R_s at the first sample."""
    s.learning.temperature_c = temperature_c
    if p.identify:
        start_filter(s, p, current_a, voltage_v, temperature_c)
    if p.learning.enabled:
        initialize_learning(s, p, voltage_v)
    if p.series_resistance:
        initialize_series_resistance(s, p)


@njit(cache=True)
def plausible_temperature(m: Record, temperature_c: float) -> float:
    """Return a plausible temperature [C], which is stored in ``m``, or NaN. ``m`` is a record of LEARNING_STATE.

    Sensors with an open wire report -127 or -300 C.
    """
    if not MIN_PLAUSIBLE_C <= temperature_c <= MAX_PLAUSIBLE_C:
        return math.nan
    m.temperature_c = temperature_c
    return temperature_c


@njit(cache=True)
def restart_after_unknown_gap(s: Record, p: Record, current_a: float, voltage_v: float, temperature_c: float) -> None:
    """Restart at the first sample with a new time base, after a gap of unknown duration."""
    if p.identify:
        if math.isfinite(temperature_c):
            s.filter.temperature_c, s.filter.sensed = temperature_c, 1
        elif not s.filter.sensed:
            s.filter.temperature_c = REFERENCE_C
        restart_filter(s, p, math.inf, current_a, voltage_v)
    if p.learning.enabled:
        initialize_states_at_rest(s, p, voltage_v)
