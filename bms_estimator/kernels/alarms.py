"""Alarms of a pack without a source of its own: values, limits, delays, and the loss of measured quantities.

The rules are those of ``telemetry.alarms``, whose evaluator a live run uses: an alarm is raised after its delay, ends after its
clear delay, and is not watched while a quantity that it needs is lost. These alarms are never acknowledged, so that none latches.
"""

import math

import numpy as np

from bms_estimator.kernels.accumulators.soc_certainty import is_soc_known
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.model.sample import MAX_CELL_V, SampleStatus
from bms_estimator.numba_cache import njit

NAMES = (
    *("pack_over_voltage", "pack_under_voltage", "cell_over_voltage", "cell_under_voltage", "cell_imbalance"),
    *("discharge_over_current", "charge_over_current"),
    *("over_temperature", "under_temperature", "charging_below_freezing", "link_lost"),
    *("soc_low", "stability_margin_low", "model_mismatch"),
    *("cell_short", "cell_sensor_fault", "weak_cell", "sensor_fault"),
)
"""Names of the alarms by their positions. States are saved by position, so that further alarms are appended."""
SAMPLE_ALARMS = 11
"""Number of alarms on the values of a sample, which come first."""
LINK_LOST = NAMES.index("link_lost")
SOC_LOW, MARGIN_LOW, MISMATCH = (NAMES.index(name) for name in ("soc_low", "stability_margin_low", "model_mismatch"))
CELL_SHORT, CELL_READING = NAMES.index("cell_short"), NAMES.index("cell_sensor_fault")
WEAK_CELL, SENSOR_FAULT = NAMES.index("weak_cell"), NAMES.index("sensor_fault")
VOLTAGE, CURRENT, TEMPERATURE, CELLS = range(4)
"""Positions of the measured quantities."""
QUANTITIES = 4
FAULTY_CLOCK, FAULTY_PROBE = 4, 5
"""Bits of ``faults`` beside those of the measured quantities."""

ALARM = np.dtype(
    [
        ("raised", "i8"),  # 1: raised
        ("has_value", "i8"),  # 1: a value has arrived
        ("holds", "i8"),  # 1: the condition of the next state holds
        ("unwatched", "i8"),  # 1: a quantity that the alarm needs is lost
        ("since_s", "f8"),  # time at which it was raised [s since 1970]
        ("value", "f8"),  # value when it was raised; NaN without a number
        ("held_s", "f8"),  # time for which the condition has held [s]
        ("missing_s", "f8"),  # time without values since the last value [s]
    ],
    align=True,
)
"""State of an alarm."""
INTERVALS = np.dtype(
    [
        ("started", "i8"),  # 1: a time is known
        ("last_s", "f8"),  # last time [s]
        ("step_s", "f8"),  # last interval above 0 [s]; 0: none
        ("longest_s", "f8"),  # longest recent interval [s]
        ("longest_at_s", "f8"),  # time of the last interval that is about as long [s]
    ],
    align=True,
)
"""Intervals between times, as in ``telemetry.alarms.sample_intervals``."""
QUANTITY = np.dtype(
    [
        ("max_count", "i8"),  # largest number of values in a sample; 0: never measured
        ("lost", "i8"),  # 1: values have been missing for longer than the delay
        ("is_missing", "i8"),  # 1: the last sample lacked values
        ("missing_s", "f8"),  # time since the first of the last samples that lack values [s]
        ("is_restored", "i8"),  # 1: a value has arrived since the loss
        ("restored_s", "f8"),  # time with values since the loss [s]
        ("value_age_s", "f8"),  # time since the last value of a lost quantity [s]
    ],
    align=True,
)
"""State of a measured quantity."""
COUNTS = np.dtype(
    [
        ("full_anchors", "i8"),
        ("empty_anchors", "i8"),
        ("searched", "i8"),  # re-initializations of the SOC
        ("reset", "i8"),  # restorations of the filter's last good state
        ("suspects", "i8"),  # bits of ``InputFault``
    ],
    align=True,
)
"""Values of the estimator whose changes are events."""
ALARMS = np.dtype(
    [
        ("states", ALARM, (len(NAMES),)),
        ("quantities", QUANTITY, (QUANTITIES,)),
        ("samples", INTERVALS),  # of samples
        ("estimates", INTERVALS),  # of accepted samples
        ("cells", INTERVALS),  # of evaluations of the single cells
        ("bank", INTERVALS),  # of evaluations of the weak cell of a bank
        ("fraction", INTERVALS),  # of evaluations of ``sensor_fault``
        ("model_suspected", "i8"),  # 1: the filter suspected the cell model at the last evaluation
        ("soc_known", "i8"),  # 1: the SOC was known at the last estimate
        ("accepted", "i8"),  # counts of accepted and unusable samples at the last evaluation of ``sensor_fault``
        ("unusable", "i8"),
        ("faults", "i8"),  # bits of the faulty inputs since then
        ("is_faulty", "i8"),  # 1: an input was faulty at ``faulty_s``
        ("faulty_s", "f8"),  # time of the last sample with a faulty input [s]
        ("reported", COUNTS),  # counts whose changes have been reported as events
    ],
    align=True,
)
"""State of all alarms of a pack. All fields are 0 before the first sample."""
LIMITS = np.dtype(
    [
        ("monitored", "i8"),  # 1: the alarm is monitored
        ("critical", "i8"),
        ("sign", "f8"),  # 1: upper limit; -1: lower limit
        ("limit", "f8"),
        ("clear", "f8"),  # level at which the alarm ends
        ("delay_s", "f8"),
        ("clear_delay_s", "f8"),
        ("needs", "i8"),  # bits of the quantities without which it cannot be evaluated
    ],
    align=True,
)
"""Definition of an alarm."""
SETTINGS = np.dtype(
    [
        ("gap_s", "f8"),  # minimum length of a gap between samples [s]
        ("lost_s", "f8"),  # time without values after which a quantity is lost [s]
        ("charging_a", "f8"),  # minimum current that counts as charging [A]
        ("series", "f8"),  # cells in series
        ("max_a", "f8"),  # highest possible current [A]
        ("range_a", "f8"),  # highest usual current [A]
        ("low_v", "f8"),  # lowest and highest usual voltage of the pack [V]
        ("high_v", "f8"),
        ("wire_v", "f8"),  # voltages that show a broken wire beside an alarm of the opposite side [V]
        ("wire_low_cell_v", "f8"),
        ("wire_high_cell_v", "f8"),
        ("sensor_suspects", "i8"),  # bits of the input faults that raise ``sensor_fault``
        ("model_suspects", "i8"),  # bits of the input faults that raise ``model_mismatch``
    ],
    align=True,
)
"""Settings of the evaluation of a pack's alarms."""
PART = np.dtype(
    [
        ("wall_offset_s", "f8"),  # wall clock minus the samples' clock [s]
        ("cells_at_s", "f8"),  # time of a new estimate of the single cells [s]; NaN: none
        ("short_a", "f8"),  # largest proven self-discharge of a cell [A]
        ("reading_v", "f8"),  # largest error of a reading of a cell [V]
        ("weak_cell_std", "f8"),  # deviation of a bank's last discharge from its reference [std]; NaN: unknown
    ],
    align=True,
)
"""Values beside the samples of a part of a block."""
CHANGE = np.dtype(
    [
        ("was_raised", "i8"),  # 1: raised
        ("has_ended", "i8"),  # 1: ended
        ("has_watch_changed", "i8"),  # 1: no longer watched, or watched again
        ("since_s", "f8"),  # time at which it was raised last [s since 1970]
        ("value", "f8"),  # value when it was raised last
    ],
    align=True,
)
"""Changes of an alarm in a block."""

MIN_MEAN_V = -1.0
"""Lowest possible mean voltage of the cells of a pack [V]. A reversed cell reaches it, but never all cells at once."""
MEAN_LOW_V, MEAN_HIGH_V = 1.0, 5.0
"""Range of the mean voltage of undamaged cells of any chemistry [V]."""
MAX_SUM_DIFFERENCE = 0.2
"""Highest possible difference between the pack's voltage and the sum of its cells, as a fraction of the higher one. Wires and
contactors drop a few percent."""
MAX_SPREAD_V = 1.0
"""Maximum difference between cells that confirm each other [V]."""
MILLI = 1000.0
"""Factor of a voltage in mV that is read as V."""
BROKEN_WIRE_V = 0.1
"""Voltage per cell below which a wire is broken [V]."""
MAX_SPACING_FRACTION = 0.5
"""Maximum interval between two values that ends a loss although samples between them lack the quantity, as a fraction of
``lost_s``. Below 1, so that a sensor that is almost lost again stays lost."""
MIN_RESTORED_S = 10.0
"""Minimum time of samples with values that ends a loss [s], also if ``lost_s`` is shorter: a loose wire must not make a relay
chatter."""
RECENT_STEPS = 4.0
"""Maximum time between two intervals above ``gap_s`` that count as regular, in multiples of the longer interval."""
CELLS_GAP_S = 60.0
"""Minimum length of a gap between two evaluations of the single cells [s]."""
FRACTION_S = 1.0
"""Minimum interval over which the fraction of unusable samples is computed [s]."""
_VOLTAGE_SATURATED, _CURRENT_SATURATED = int(SampleStatus.VOLTAGE_SATURATED), int(SampleStatus.CURRENT_SATURATED)
_WRONG_CLOCK, _PROBE_FAULT = int(SampleStatus.WRONG_CLOCK), int(SampleStatus.PROBE_FAULT)


@njit(cache=True)
def evaluate(
    alarms: Records,
    limits: Records,
    settings: Records,
    part: Records,
    estimator: Records,
    samples: Records,
    cells_v: Floats,
    trace: Records,
    scratch: Floats,
    changes: Records,
) -> int:
    """Evaluate all alarms on samples and their estimates.

    Args:
        alarms: Shape (1,), dtype ALARMS; updated in place.
        limits: Definitions of the alarms, dtype LIMITS.
        settings: Shape (1,), dtype SETTINGS.
        part: Shape (1,), dtype PART.
        estimator: State of the estimator after the samples, shape (1,), dtype ESTIMATOR_STATE.
        samples: Shape (n,), dtype SAMPLE. A sample without a time has no effect.
        cells_v: Cell voltages, shape (n, m) [V]; of another length without any.
        trace: Estimates of the accepted samples, dtype TRACE.
        scratch: Shape (6, n) or longer, and at least ``SAMPLE_ALARMS``; overwritten.
        changes: Changes of the alarms, dtype CHANGE; updated in place.

    Returns:
        Bit 0: an alarm has changed. Bit 1: the values of dtype COUNTS differ from those reported.
    """
    a, p, b, e = alarms[0], settings[0], part[0], estimator[0]
    states = a.states
    a.quantities[CELLS].max_count = min(a.quantities[CELLS].max_count, int(p.series))  # the settings may have changed
    for k in range(states.shape[0]):
        if states[k].raised and not limits[k].monitored:
            states[k].raised = 0
    end_s = _evaluate_samples(a, states, limits, p, samples, cells_v, b.wall_offset_s, scratch, changes)
    if not math.isnan(end_s):
        _update_quantities(a, states, limits, p, samples, b.wall_offset_s, scratch, changes)
        _evaluate_inputs(a, states, limits, p, end_s, e, b.wall_offset_s, changes)
    if trace.shape[0]:
        is_suspected = e.checks.suspects & p.model_suspects != 0
        _evaluate_estimates(a, states, limits, p, trace, is_suspected, b.wall_offset_s, changes)
    if not math.isnan(b.weak_cell_std) and not math.isnan(end_s):
        step_s = _step_intervals(a.bank, end_s, math.inf)[1]  # no gap, because a weak cell remains weak
        _update(
            states[WEAK_CELL],
            limits[WEAK_CELL],
            changes[WEAK_CELL],
            p,
            b.wall_offset_s,
            end_s,
            step_s,
            b.weak_cell_std,
            0,
        )
    if not math.isnan(b.cells_at_s):
        step_s = _step_intervals(a.cells, b.cells_at_s, CELLS_GAP_S)[1]
        for k, value in ((CELL_SHORT, b.short_a), (CELL_READING, b.reading_v)):
            _update(states[k], limits[k], changes[k], p, b.wall_offset_s, b.cells_at_s, step_s, value, 0)
    has_changed = 0
    for k in range(changes.shape[0]):
        c = changes[k]
        has_changed |= c.was_raised | c.has_ended | c.has_watch_changed
    r, anchors = a.reported, e.anchors
    is_reported = (
        r.full_anchors == anchors.full_anchors
        and r.empty_anchors == anchors.empty_anchors
        and r.searched == e.filter.reopened
        and r.reset == e.counters.reset
        and r.suspects == e.checks.suspects
    )
    return has_changed | (0 if is_reported else 2)


@njit(cache=True)
def mark_reported(alarms: Records, estimator: Records) -> None:
    """Record the present values of dtype COUNTS as reported. ``evaluate`` describes the arguments."""
    r, e = alarms[0].reported, estimator[0]
    r.full_anchors, r.empty_anchors = e.anchors.full_anchors, e.anchors.empty_anchors
    r.searched, r.reset, r.suspects = e.filter.reopened, e.counters.reset, e.checks.suspects


@njit(cache=True)
def _evaluate_samples(
    a: Record,
    states: Records,
    limits: Records,
    p: Record,
    samples: Records,
    cells_v: Floats,
    wall_offset_s: float,
    scratch: Floats,
    changes: Records,
) -> float:
    """Evaluate the alarms on measured values. Return the time of the last sample [s]; NaN without one.

    Row 0 of ``scratch`` becomes the time for which the value before each sample holds, -1 for a sample without a time [s], and
    rows 1 to 4 the numbers of its values.
    """
    expected_cells, values = a.quantities[CELLS].max_count, scratch[5]
    end_s = math.nan
    for j in range(samples.shape[0]):
        x = samples[j]
        scratch[0, j] = -1.0
        if not math.isfinite(x.time_s):
            continue
        end_s = x.time_s
        passed_s, observed_s = _step_intervals(a.samples, x.time_s, p.gap_s)
        scratch[0, j] = observed_s
        low_v, high_v, cells, mean_v = _cell_extremes(cells_v, j, samples.shape[0])
        voltage_v, current_a, bad = _possible_values(p, x, low_v, high_v, cells, mean_v)
        if bad & (1 << CELLS):
            low_v = high_v = math.nan
        a.faults |= bad
        if x.status & _WRONG_CLOCK:
            a.faults |= 1 << FAULTY_CLOCK
        if x.status & _PROBE_FAULT:
            a.faults |= 1 << FAULTY_PROBE
        _measured_values(p, x, voltage_v, current_a, low_v, high_v, passed_s, observed_s, values)
        uncertain = _uncertain(p, x, voltage_v, current_a, low_v, high_v, cells, expected_cells)
        for k in range(SAMPLE_ALARMS):
            step_s = passed_s if k == LINK_LOST else observed_s
            is_uncertain = uncertain >> k & 1
            _update(states[k], limits[k], changes[k], p, wall_offset_s, x.time_s, step_s, values[k], is_uncertain)
        _count_values(p, x, voltage_v, current_a, cells, bad, scratch, j)
    return end_s


@njit(cache=True)
def _update_quantities(
    a: Record,
    states: Records,
    limits: Records,
    p: Record,
    samples: Records,
    wall_offset_s: float,
    scratch: Floats,
    changes: Records,
) -> None:
    """Update the loss of measured quantities, and the alarms that cannot be watched because of it."""
    changed_s = math.nan  # time of the first loss or return
    for q in range(QUANTITIES):
        for j in range(samples.shape[0]):
            step_s, count = scratch[0, j], int(scratch[1 + q, j])
            if step_s >= 0.0 and _step_quantity(a.quantities[q], step_s, count, p.lost_s) and math.isnan(changed_s):
                changed_s = samples[j].time_s
    lost = lost_quantities(a)
    for k in range(states.shape[0]):
        s, d = states[k], limits[k]
        # a critical alarm whose delay runs stays unwatched until it is raised
        is_held = s.unwatched and d.critical and s.holds and not s.raised
        unwatched = 1 if d.monitored and (is_held or d.needs & lost) else 0
        if unwatched != s.unwatched:
            s.unwatched, changes[k].has_watch_changed = unwatched, 1
    if not math.isnan(changed_s) and _is_blinded(states, limits, lost):
        # without the delay of the alarm, because a quantity has been missing for ``lost_s``
        s, d, c = states[SENSOR_FAULT], limits[SENSOR_FAULT], changes[SENSOR_FAULT]
        _raise(s, d, c, changed_s + wall_offset_s, math.nan)


@njit(cache=True)
def lost_quantities(a: Record) -> int:
    """Return the bits of the lost quantities of a record of dtype ALARMS."""
    lost = 0
    for q in range(QUANTITIES):
        lost |= a.quantities[q].lost << q
    return lost


@njit(cache=True)
def _is_blinded(states: Records, limits: Records, lost: int) -> bool:
    """Return True if a critical alarm is unwatched because of a lost quantity, of which ``lost`` has the bits."""
    is_blinded = False
    for k in range(states.shape[0]):
        is_blinded |= states[k].unwatched != 0 and limits[k].critical != 0 and limits[k].needs & lost != 0
    return is_blinded


@njit(cache=True)
def _evaluate_inputs(
    a: Record,
    states: Records,
    limits: Records,
    p: Record,
    at_s: float,
    e: Record,
    wall_offset_s: float,
    changes: Records,
) -> None:
    """Evaluate the alarm ``sensor_fault`` on the fraction of unusable samples, faulty inputs, and suspicions of the filter."""
    is_first = not a.fraction.started
    if not is_first and 0.0 <= at_s - a.fraction.last_s < FRACTION_S:
        return
    step_s = _step_intervals(a.fraction, at_s, math.inf)[1]  # losses are counted in gaps, too
    o = e.observer
    unusable = o.dropped_not_finite + o.dropped_range + o.dropped_saturated
    good, bad = o.samples - a.accepted, unusable - a.unusable
    if good < 0 or bad < 0:  # the counters were reset
        good, bad = o.samples, unusable
    a.accepted, a.unusable = o.samples, unusable
    value = math.nan if is_first or good + bad <= 0 else bad / (good + bad)
    s, d, c = states[SENSOR_FAULT], limits[SENSOR_FAULT], changes[SENSOR_FAULT]
    if e.checks.suspects & p.sensor_suspects or a.faults or _is_blinded(states, limits, lost_quantities(a)):
        value, a.faulty_s, a.is_faulty = math.inf, at_s, 1
    elif a.is_faulty and at_s - a.faulty_s <= MAX_SPACING_FRACTION * p.lost_s and not s.raised:
        value = math.nan  # a sample without a fault does not restart the delay of an intermittent one
    a.faults = 0
    _update(s, d, c, p, wall_offset_s, at_s, step_s, value, 0)


@njit(cache=True)
def _evaluate_estimates(
    a: Record,
    states: Records,
    limits: Records,
    p: Record,
    trace: Records,
    is_suspected: bool,
    wall_offset_s: float,
    changes: Records,
) -> None:
    """Evaluate the alarms on estimates. ``is_suspected`` is True if the filter suspects the cell model after them."""
    last = trace.shape[0] - 1
    was_suspected, known = a.model_suspected != 0, a.soc_known != 0
    a.model_suspected = 1 if is_suspected else 0
    for j in range(trace.shape[0]):
        x = trace[j]
        step_s = _step_intervals(a.estimates, x.time_s, p.gap_s)[1]
        known = is_soc_known(x.soc_std, known)
        soc_low = x.soc - (0.0 if math.isnan(x.soc_std) else x.soc_std) if known else math.nan
        has_margin = not math.isnan(x.stability_margin) or math.isnan(x.soc)
        margin = (x.stability_margin if known else math.nan) if has_margin else math.inf
        # a new suspicion counts from the last sample on, because its start is unknown
        is_mismatch = x.lock == 0 or was_suspected or (j == last and is_suspected)
        mismatch_v = math.inf if is_mismatch else abs(x.innovation_v)
        for k, value in ((SOC_LOW, soc_low), (MARGIN_LOW, margin), (MISMATCH, mismatch_v)):
            _update(states[k], limits[k], changes[k], p, wall_offset_s, x.time_s, step_s, value, 0)
    a.soc_known = 1 if known else 0


@njit(cache=True)
def begin_time_base(alarms: Records) -> None:
    """Begin samples with another time base. The time since the last sample counts toward no delay."""
    a = alarms[0]
    for s in (a.samples, a.estimates, a.cells, a.bank, a.fraction):
        s.started, s.longest_s = 0, 0.0
    a.is_faulty = 0


@njit(cache=True)
def _update(
    s: Record,
    d: Record,
    c: Record,
    p: Record,
    wall_offset_s: float,
    at_s: float,
    step_s: float,
    measured: float,
    is_uncertain: int,
) -> None:
    """Process a value of an alarm.

    Args:
        s: State of the alarm, a record of dtype ALARM.
        d: Its definition, a record of dtype LIMITS.
        c: Its changes, a record of dtype CHANGE.
        p: Record of dtype SETTINGS.
        wall_offset_s: Wall clock minus the samples' clock [s].
        at_s: Time on the samples' clock [s].
        step_s: Interval since the previous value, which counts toward the delays [s].
        measured: Value in the unit of the limit; NaN (not measured) neither raises nor ends the alarm.
        is_uncertain: 1: the true value may be beyond the limit. It neither ends the alarm nor its delay.
    """
    if not d.monitored:
        return
    value, limit = d.sign * measured, d.sign * d.limit
    if is_uncertain and (s.raised or s.holds) and not value > limit:
        value = limit
    if math.isnan(value):
        s.missing_s += step_s
        return
    s.has_value = 1
    if s.missing_s < p.lost_s:
        step_s += s.missing_s
    s.missing_s = 0.0
    if not (value < d.sign * d.clear if s.raised else value >= limit):
        s.holds, s.held_s = 0, 0.0
        return
    s.held_s = s.held_s + step_s if s.holds else 0.0
    s.holds = 1
    if s.held_s < (d.clear_delay_s if s.raised else d.delay_s):
        return
    if s.raised:
        s.raised, s.holds, s.since_s, s.value, s.held_s = 0, 0, 0.0, 0.0, 0.0
        c.has_ended = 1
    else:
        _raise(s, d, c, at_s + wall_offset_s, d.sign * value if math.isfinite(value) else math.nan)


@njit(cache=True)
def _raise(s: Record, d: Record, c: Record, since_s: float, value: float) -> None:
    """Raise an alarm without its delay, if it is monitored and not raised. ``_update`` describes the records."""
    if d.monitored and not s.raised:
        s.raised, s.holds, s.since_s, s.value, s.held_s = 1, 0, since_s, value, 0.0
        c.was_raised, c.since_s, c.value = 1, since_s, value


@njit(cache=True)
def _step_intervals(s: Record, at_s: float, gap_s: float) -> tuple[float, float]:
    """Return the interval before a time, and the part of it for which a value holds, which is 0 in a gap [s].

    Intervals that are repeated, as before bursts of samples, are no gaps.
    """
    passed_s = at_s - s.last_s if s.started else 0.0
    if not passed_s > 0.0:  # also after the clock was set back
        passed_s = 0.0
    before_s = s.step_s if s.step_s > 0.0 else math.inf
    observed_s = 0.0 if passed_s > max(gap_s, GAP_RATIO * before_s) else passed_s
    if passed_s > gap_s:
        is_recent = s.longest_s > 0.0 and abs(at_s - s.longest_at_s) <= RECENT_STEPS * s.longest_s
        if is_recent and passed_s <= GAP_RATIO * s.longest_s:
            observed_s = passed_s
        if not is_recent or passed_s >= s.longest_s:
            s.longest_s, s.longest_at_s = passed_s, at_s
        elif GAP_RATIO * passed_s >= s.longest_s:
            s.longest_at_s = at_s
    s.started, s.last_s = 1, at_s
    if passed_s > 0.0:
        s.step_s = passed_s
    return passed_s, observed_s


@njit(cache=True)
def _step_quantity(s: Record, step_s: float, count: int, lost_s: float) -> bool:
    """Process the number of values of a quantity in a sample, negative for unusable ones. Return True if ``lost`` has changed."""
    s.max_count = max(s.max_count, count)
    was_lost, follows_value = s.lost, not s.is_missing
    s.value_age_s += step_s
    if count < s.max_count or count < 0:
        s.missing_s = 0.0 if follows_value else s.missing_s + step_s
        s.is_missing = 1
        if s.missing_s >= lost_s:
            s.lost, s.is_restored = 1, 0
    else:
        s.is_missing = 0
        if s.lost:
            continues = follows_value or s.value_age_s <= MAX_SPACING_FRACTION * lost_s
            s.restored_s = s.restored_s + s.value_age_s if continues and s.is_restored else 0.0
            s.is_restored, s.lost = 1, 1 if s.restored_s < max(lost_s, MIN_RESTORED_S) else 0
        s.value_age_s = 0.0
    return s.lost != was_lost


@njit(cache=True)
def _cell_extremes(cells_v: Floats, j: int, n: int) -> tuple[float, float, int, float]:
    """Return minimum, maximum [V], number and mean [V] of the cell voltages of sample ``j`` of ``n``; NaN without any."""
    low_v = high_v = math.nan
    count, sum_v = 0, 0.0
    if cells_v.shape[0] == n:
        for i in range(cells_v.shape[1]):
            v = cells_v[j, i]
            if not math.isnan(v):
                low_v, high_v = (v, v) if math.isnan(low_v) else (min(low_v, v), max(high_v, v))
                sum_v += v
                count += math.isfinite(v)
    return low_v, high_v, count, sum_v / count if count else math.nan


@njit(cache=True)
def _possible_values(
    p: Record, x: Record, low_v: float, high_v: float, cells: int, mean_v: float
) -> tuple[float, float, int]:
    """Return voltage [V] and current [A], NaN if they cannot be true of a pack, and the bits of impossible quantities.

    The rules are those of ``telemetry.impossible``.
    """
    pack_v = x.voltage_v / p.series
    is_outside = pack_v < MIN_MEAN_V or pack_v > MAX_CELL_V
    differs = cells == p.series and abs(pack_v - mean_v) > MAX_SUM_DIFFERENCE * max(abs(pack_v), abs(mean_v))
    pack_is_usual, cells_are_usual = MEAN_LOW_V <= pack_v <= MEAN_HIGH_V, MEAN_LOW_V <= mean_v <= MEAN_HIGH_V
    cells_agree = high_v - low_v <= MAX_SPREAD_V
    bad, voltage_v, current_a = 0, x.voltage_v, x.current_a
    if is_outside or (differs and cells_are_usual and (not pack_is_usual or cells_agree)):
        bad, voltage_v = 1 << VOLTAGE, math.nan
    if differs and pack_is_usual and not cells_are_usual:
        bad |= 1 << CELLS
    is_milli = MILLI * p.low_v <= x.voltage_v <= MILLI * p.high_v  # then the current is, too
    if abs(x.current_a) > (p.range_a if is_milli else p.max_a) and not x.status & _CURRENT_SATURATED:
        bad |= 1 << CURRENT
        current_a = math.nan
    return voltage_v, current_a, bad


@njit(cache=True)
def _measured_values(
    p: Record,
    x: Record,
    voltage_v: float,
    measured_a: float,
    low_v: float,
    high_v: float,
    passed_s: float,
    observed_s: float,
    out: Floats,
) -> None:
    """Write the values of the alarms on a sample to ``out``, in the order of ``NAMES``."""
    has_extremes = x.temperature_min_c <= x.temperature_c <= x.temperature_max_c
    coldest_c = x.temperature_min_c if has_extremes else x.temperature_c
    hottest_c = x.temperature_max_c if has_extremes else x.temperature_c
    # a saturated value is beyond the range of the converter, and therefore beyond every limit
    current_a = math.copysign(math.inf, measured_a) if x.status & _CURRENT_SATURATED else measured_a
    charging_c = coldest_c if current_a <= -p.charging_a else math.inf
    if math.isnan(current_a) or math.isnan(coldest_c):
        charging_c = math.nan
    out[0], out[1] = math.inf if x.status & _VOLTAGE_SATURATED else voltage_v, voltage_v
    out[2], out[3], out[4] = high_v, low_v, high_v - low_v
    out[5], out[6] = current_a, -current_a
    out[7], out[8], out[9] = hottest_c, coldest_c, charging_c
    out[LINK_LOST] = passed_s if observed_s < passed_s else 0.0  # duration of the gap before the sample; 0: no gap


@njit(cache=True)
def _uncertain(
    p: Record,
    x: Record,
    voltage_v: float,
    current_a: float,
    low_v: float,
    high_v: float,
    cells: int,
    expected_cells: int,
) -> int:
    """Return the bits of the alarms whose true value may be beyond the limit although the measured one is not.

    The rules are those of ``telemetry.alarms.measured_values.uncertain_values``.
    """
    has_probe_fault = (x.status & _PROBE_FAULT) != 0
    lacks_cell = 0 < cells < expected_cells
    bits = 0
    if voltage_v < p.wire_v:
        bits |= 1 << 0
    if x.status & _VOLTAGE_SATURATED:
        bits |= 1 << 1
    if lacks_cell or low_v < p.wire_low_cell_v:
        bits |= 1 << 2
    if lacks_cell or high_v > p.wire_high_cell_v:
        bits |= 1 << 3
    if x.status & _CURRENT_SATURATED:
        bits |= 1 << 5 | 1 << 6
    if has_probe_fault:
        bits |= 1 << 7 | 1 << 8
        if current_a < 0.0:
            bits |= 1 << 9
    return bits


@njit(cache=True)
def _count_values(
    p: Record, x: Record, voltage_v: float, current_a: float, cells: int, bad: int, out: Floats, j: int
) -> None:
    """Write the numbers of values of a sample to column ``j`` of rows 1 to 4 of ``out``, -1 for unusable ones."""
    out[1 + VOLTAGE, j] = 1.0 if math.isfinite(voltage_v) else 0.0
    out[1 + CURRENT, j] = 1.0 if math.isfinite(current_a) else 0.0
    out[1 + TEMPERATURE, j] = 1.0 if math.isfinite(x.temperature_c) else 0.0
    out[1 + CELLS, j] = min(float(cells), p.series)
    if voltage_v < BROKEN_WIRE_V * p.series or x.status & _VOLTAGE_SATURATED:
        bad |= 1 << VOLTAGE
    if x.status & _CURRENT_SATURATED:
        bad |= 1 << CURRENT
    if x.status & _PROBE_FAULT and math.isnan(x.temperature_c):  # missing, also if it was never measured
        bad |= 1 << TEMPERATURE
    for q in range(QUANTITIES):
        if bad >> q & 1:
            out[1 + q, j] = -1.0
