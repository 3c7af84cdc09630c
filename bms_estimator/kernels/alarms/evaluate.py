"""Evaluation of all alarms of a pack on a block of samples and their estimates.

An alarm is raised after its delay, ends after its clear delay and, if it latches, after an acknowledgement. It is not watched
while a quantity that it needs is lost.

``a`` is a record of ALARMS, ``p`` of SETTINGS, ``b`` of EVALUATION_IO, ``e`` of ESTIMATOR_STATE.
"""

import math

from bms_estimator.kernels.accumulators.publish_window import is_soc_known
from bms_estimator.kernels.alarms.quantities import (
    MAX_SPACING_FRACTION,
    cell_extremes,
    count_values,
    is_blinded,
    lost_quantities,
    measured_values,
    possible_values,
    step_intervals,
    uncertain_values,
    update_quantities,
)
from bms_estimator.kernels.alarms.records import (
    CELL_READING,
    CELL_SHORT,
    CELLS,
    COLLAPSE_RISK,
    FAULTY_CLOCK,
    FAULTY_PROBE,
    LINK_LOST,
    MARGIN_LOW,
    MISMATCH,
    QUANTITIES,
    SAMPLE_ALARMS,
    SENSOR_FAULT,
    SOC_LOW,
    WEAK_CELL,
    raise_now,
    update,
)
from bms_estimator.model.arrays import Floats, Record, Records, SampleStatus
from bms_estimator.numba_cache import njit

CELLS_GAP_S = 60.0
"""Minimum length of a gap between two evaluations of the single cells [s]."""
FRACTION_S = 1.0
"""Minimum interval over which the fraction of unusable samples is computed [s]."""
_WRONG_CLOCK, _PROBE_FAULT = int(SampleStatus.WRONG_CLOCK), int(SampleStatus.PROBE_FAULT)


@njit(cache=True)
def evaluate(
    alarms: Records,
    limits: Records,
    settings: Records,
    io: Records,
    estimator: Records,
    samples: Records,
    cells_v: Floats,
    trace: Records,
    cutoff_risk: Floats,
    scratch: Floats,
    log: Records,
) -> bool:
    """Evaluate all alarms on samples and their estimates.

    Args:
        alarms: Shape (1,), dtype ALARMS; updated in place.
        limits: Definitions of the alarms, dtype LIMITS.
        settings: Shape (1,), dtype SETTINGS.
        io: Shape (1,), dtype EVALUATION_IO; its results are updated.
        estimator: State of the estimator after the samples, shape (1,), dtype ESTIMATOR_STATE.
        samples: Shape (n,), dtype SAMPLE. A sample without a time has no effect.
        cells_v: Cell voltages, shape (n, cells) [V]; an array of another length if none are measured.
        trace: Estimates of the accepted samples, dtype TRACE.
        cutoff_risk: Probability of the cut-off within 5 min at each row of ``trace``, 0..1, or a single one for all of them;
            NaN without a forecast.
        scratch: Six rows of at least n and at least ``SAMPLE_ALARMS`` elements; overwritten.
        log: Receives the changes, dtype LOG, from ``io.logged`` on.

    Returns:
        True if the values of dtype COUNTS differ from those reported.
    """
    a, p, b, e = alarms[0], settings[0], io[0], estimator[0]
    states = a.states
    a.quantities[CELLS].max_count = min(a.quantities[CELLS].max_count, int(p.series))  # the settings may have changed
    b.inputs_evaluated = 0
    for q in range(QUANTITIES):
        b.impossible[q] = 0
    for k in range(states.shape[0]):
        if states[k].raised and not limits[k].monitored:
            states[k].raised = 0
    end_s = _evaluate_samples(a, limits, p, b, samples, cells_v, scratch, log)
    if not math.isnan(end_s):
        update_quantities(alarms, limits, settings, io, samples, scratch, log, end_s)
        _evaluate_inputs(a, limits, p, b, e, log, end_s)
    if trace.shape[0]:
        _evaluate_estimates(a, limits, p, b, trace, cutoff_risk, e.checks.suspects & p.model_suspects != 0, log)
    if not math.isnan(b.weak_cell_std) and not math.isnan(end_s):
        # gaps count toward the delay, because a weak cell remains weak
        step_s = step_intervals(a.bank, end_s, math.inf)[1]
        update(states[WEAK_CELL], limits[WEAK_CELL], p, b, log, WEAK_CELL, end_s, step_s, b.weak_cell_std, 0)
    if not math.isnan(b.cells_at_s):
        step_s = step_intervals(a.cells, b.cells_at_s, CELLS_GAP_S)[1]
        for k, value in ((CELL_SHORT, b.short_a), (CELL_READING, b.reading_v)):
            update(states[k], limits[k], p, b, log, k, b.cells_at_s, step_s, value, 0)
    r, anchors = a.reported, e.anchors
    return not (
        r.full_anchors == anchors.full_anchors
        and r.empty_anchors == anchors.empty_anchors
        and r.searched == e.filter.reopened
        and r.reset == e.counters.reset
        and r.suspects == e.checks.suspects
    )


@njit(cache=True)
def mark_reported(alarms: Records, estimator: Records) -> None:
    """Record the present values of dtype COUNTS as reported. ``evaluate`` describes the arguments."""
    r, e = alarms[0].reported, estimator[0]
    r.full_anchors, r.empty_anchors = e.anchors.full_anchors, e.anchors.empty_anchors
    r.searched, r.reset, r.suspects = e.filter.reopened, e.counters.reset, e.checks.suspects


@njit(cache=True)
def begin_time_base(alarms: Records) -> None:
    """Begin samples with another time base. The time since the last sample counts toward no delay."""
    a = alarms[0]
    for s in (a.samples, a.estimates, a.cells, a.bank, a.fraction):
        s.started, s.longest_s = 0, 0.0
    a.is_faulty = 0


@njit(cache=True)
def update_alarm(
    alarms: Records,
    limits: Records,
    settings: Records,
    io: Records,
    log: Records,
    k: int,
    at_s: float,
    step_s: float,
    value: float,
) -> None:
    """Process a value of alarm ``k`` that no sample contains. ``records.update`` describes the last three arguments."""
    update(alarms[0].states[k], limits[k], settings[0], io[0], log, k, at_s, step_s, value, 0)


@njit(cache=True)
def raise_alarm(
    alarms: Records, limits: Records, io: Records, log: Records, k: int, since_s: float, value: float
) -> None:
    """Raise alarm ``k`` at the last sample, without its delay. ``states.raise_now`` describes the last two arguments."""
    a = alarms[0]
    raise_now(a.states[k], limits[k], io[0], log, k, a.samples.last_s, since_s, value)


@njit(cache=True)
def _evaluate_samples(
    a: Record,
    limits: Records,
    p: Record,
    b: Record,
    samples: Records,
    cells_v: Floats,
    scratch: Floats,
    log: Records,
) -> float:
    """Evaluate the alarms on measured values. Return the time of the last sample [s]; NaN without one.

    Row 0 of ``scratch`` receives the observed interval before each sample, or -1 for a sample without a time [s]. Rows 1 to 4
    receive the number of values of each measured quantity.
    """
    states, expected_cells, values = a.states, a.quantities[CELLS].max_count, scratch[5]
    end_s = math.nan
    for j in range(samples.shape[0]):
        x = samples[j]
        scratch[0, j] = -1.0
        if not math.isfinite(x.time_s):
            continue
        end_s = x.time_s
        passed_s, observed_s = step_intervals(a.samples, x.time_s, p.gap_s)
        # the interval before the first sample is a part of the silence
        b.watched_s = 0.0 if math.isnan(b.watched_s) else b.watched_s + observed_s
        scratch[0, j] = observed_s
        low_v, high_v, cells, mean_v = cell_extremes(cells_v, j, samples.shape[0])
        voltage_v, current_a, bad = possible_values(p, x, low_v, high_v, cells, mean_v)
        for q in range(QUANTITIES):
            if bad >> q & 1:
                b.impossible[q] = j + 1
        if bad & (1 << CELLS):
            low_v = high_v = math.nan
        a.faults |= bad
        if x.status & _WRONG_CLOCK:
            a.faults |= 1 << FAULTY_CLOCK
        if x.status & _PROBE_FAULT:
            a.faults |= 1 << FAULTY_PROBE
        measured_values(p, x, voltage_v, current_a, low_v, high_v, passed_s, observed_s, values)
        uncertain = uncertain_values(p, x, voltage_v, current_a, low_v, high_v, cells, expected_cells)
        for k in range(SAMPLE_ALARMS):
            step_s = passed_s if k == LINK_LOST else observed_s
            update(states[k], limits[k], p, b, log, k, x.time_s, step_s, values[k], uncertain >> k & 1)
        count_values(p, x, voltage_v, current_a, cells, bad, b.cells_unusable, scratch, j)
    return end_s


@njit(cache=True)
def _evaluate_inputs(a: Record, limits: Records, p: Record, b: Record, e: Record, log: Records, at_s: float) -> None:
    """Evaluate the alarm ``sensor_fault`` on the fraction of unusable samples, faulty inputs, and suspicions of the filter."""
    is_first = not a.fraction.started
    if not is_first and 0.0 <= at_s - a.fraction.last_s < FRACTION_S:
        return
    # gaps count toward the delay, because losses are also counted in gaps
    step_s = step_intervals(a.fraction, at_s, math.inf)[1]
    o = e.observer
    unusable = o.dropped_not_finite + o.dropped_range + o.dropped_saturated + b.lost
    good, bad = o.samples - a.accepted, unusable - a.unusable
    if good < 0 or bad < 0:  # the counters were reset
        good, bad = o.samples, unusable
    a.accepted, a.unusable = o.samples, unusable
    value = math.nan if is_first or good + bad <= 0 else bad / (good + bad)
    s, d = a.states[SENSOR_FAULT], limits[SENSOR_FAULT]
    if e.checks.suspects & p.sensor_suspects or a.faults or is_blinded(a.states, limits, lost_quantities(a)):
        value, a.faulty_s, a.is_faulty = math.inf, at_s, 1
    elif a.is_faulty and at_s - a.faulty_s <= MAX_SPACING_FRACTION * p.lost_s and not s.raised:
        value = math.nan  # a sample without a fault does not restart the delay of an intermittent one
    a.faults, b.inputs_evaluated = 0, 1
    update(s, d, p, b, log, SENSOR_FAULT, at_s, step_s, value, 0)


@njit(cache=True)
def _evaluate_estimates(
    a: Record,
    limits: Records,
    p: Record,
    b: Record,
    trace: Records,
    cutoff_risk: Floats,
    is_suspected: bool,
    log: Records,
) -> None:
    """Evaluate the alarms on estimates. ``is_suspected`` is True if the filter suspects the cell model after them.

    The value of ``collapse_risk`` is the probability of the cut-off. Without a forecast it is 0 during a charge.
    """
    states, last = a.states, trace.shape[0] - 1
    was_suspected, known = a.model_suspected != 0, a.soc_known != 0
    a.model_suspected = 1 if is_suspected else 0
    for j in range(trace.shape[0]):
        x = trace[j]
        step_s = step_intervals(a.estimates, x.time_s, p.gap_s)[1]
        known = is_soc_known(x.soc_std, known)
        soc_low = x.soc - (0.0 if math.isnan(x.soc_std) else x.soc_std) if known else math.nan
        # without a margin the value is infinite, which ends an alarm that an earlier margin raised
        has_margin = not math.isnan(x.stability_margin) or math.isnan(x.soc)
        margin = (x.stability_margin if known else math.nan) if has_margin else math.inf
        # a new suspicion counts from the last sample on, because its start is unknown
        is_mismatch = x.lock == 0 or was_suspected or (j == last and is_suspected)
        mismatch_v = math.inf if is_mismatch else abs(x.innovation_v)
        risk = cutoff_risk[min(j, cutoff_risk.shape[0] - 1)]
        if math.isnan(risk) and x.current_a <= -p.charging_a:
            risk = 0.0
        for k, value in ((SOC_LOW, soc_low), (MARGIN_LOW, margin), (MISMATCH, mismatch_v), (COLLAPSE_RISK, risk)):
            update(states[k], limits[k], p, b, log, k, x.time_s, step_s, value, 0)
    a.soc_known = 1 if known else 0
