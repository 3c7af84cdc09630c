"""Names, states, definitions and changes of alarms, and the state machine of an alarm: hysteresis, delays and latch.

The delays run on the samples' clock.
"""

import math

import numpy as np

from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

NAMES = (
    *("pack_over_voltage", "pack_under_voltage", "cell_over_voltage", "cell_under_voltage", "cell_imbalance"),
    *("discharge_over_current", "charge_over_current"),
    *("over_temperature", "under_temperature", "charging_below_freezing", "link_lost"),
    *("soc_low", "stability_margin_low", "model_mismatch"),
    *("cell_short", "cell_sensor_fault", "weak_cell", "sensor_fault"),
    *("collapse_risk", "hook_failed", "alarm_state_lost"),
)
"""Names of the alarms by their positions. States are saved by position, so new alarms must be appended."""
SAMPLE_ALARMS = 11
"""Number of alarms on the values of a sample, which come first."""
LINK_LOST = NAMES.index("link_lost")
SOC_LOW, MARGIN_LOW, MISMATCH = (NAMES.index(name) for name in ("soc_low", "stability_margin_low", "model_mismatch"))
CELL_SHORT, CELL_READING = NAMES.index("cell_short"), NAMES.index("cell_sensor_fault")
WEAK_CELL, SENSOR_FAULT = NAMES.index("weak_cell"), NAMES.index("sensor_fault")
COLLAPSE_RISK = NAMES.index("collapse_risk")
VOLTAGE, CURRENT, TEMPERATURE, CELLS = range(4)
"""Positions of the measured quantities."""
QUANTITIES = 4
FAULTY_CLOCK, FAULTY_PROBE, FAULTY_BOARD = 4, 5, 6
"""Bits of ``faults`` beside those of the measured quantities."""
RAISED, ENDED, WATCH_CHANGED = 1, 2, 3
"""Kinds of changes: raised, ended, no longer watched or watched again."""

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
        ("cause_cleared", "i8"),  # 1: the cause is gone, but the alarm is latched
        ("acknowledged", "i8"),  # 1: acknowledged, so that it ends once its cause is gone
        ("is_uncertain", "i8"),  # 1: the last value was uncertain, and the measured one not beyond the limit
        # 1: acknowledged at an uncertain value, and no measured value has been beyond the limit since
        ("accepts_uncertain", "i8"),
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
"""State of ``step_intervals``."""
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
        ("latch", "i8"),  # 1: it ends only after an acknowledgement
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
        ("max_a", "f8"),  # highest current that the pack can have; a higher one is a faulty input [A]
        # highest current of usual loads; also the limit of a current whose voltage shows that the source sends mV and mA [A]
        ("range_a", "f8"),
        ("low_v", "f8"),  # lowest and highest usual voltage of the pack [V]
        ("high_v", "f8"),
        # voltages beyond which a wire may be broken, so that the alarm of the opposite limit is uncertain [V]
        ("wire_v", "f8"),
        ("wire_low_cell_v", "f8"),
        ("wire_high_cell_v", "f8"),
        ("steep_v", "f8"),  # voltage of the highest cell from which the difference between cells is not judged [V]
        ("sensor_suspects", "i8"),  # bits of the input faults that raise ``sensor_fault``
        ("model_suspects", "i8"),  # bits of the input faults that raise ``model_mismatch``
    ],
    align=True,
)
"""Settings of the evaluation of a pack's alarms."""
EVALUATION_IO = np.dtype(
    [
        ("wall_offset_s", "f8"),  # wall clock minus the samples' clock [s]
        # time of a new estimate of the single cells [s]; NaN: no new one, and the next two fields are not used
        ("cells_at_s", "f8"),
        ("short_a", "f8"),  # largest proven self-discharge of a cell [A]
        ("reading_v", "f8"),  # largest error of the measured voltage of a cell [V]
        ("weak_cell_std", "f8"),  # deviation of a bank's last discharge from its reference [std]; NaN: unknown
        ("lost", "i8"),  # number of samples since start that were lost on the line
        ("is_silent", "i8"),  # 1: no samples arrive, or they have arrived again for a short time only
        ("cells_unusable", "i8"),  # 1: samples without cell voltages have some that cannot be used
        # duration of the samples since the start or the last silence, without gaps; NaN during a silence [s]; updated
        ("watched_s", "f8"),
        # results: entries of the log, 1 after an evaluation of ``sensor_fault``, and for each quantity the index of the last
        # sample with an impossible value, plus 1
        ("logged", "i8"),
        ("inputs_evaluated", "i8"),
        ("impossible", "i8", (QUANTITIES,)),
    ],
    align=True,
)
"""Further inputs of an evaluation, beside the samples, and its results."""
LOG = np.dtype(
    [
        ("alarm", "i8"),  # position in ``NAMES``
        ("kind", "i8"),  # ``RAISED``, ``ENDED`` or ``WATCH_CHANGED``
        ("at_s", "f8"),  # time on the samples' clock [s]
        ("since_s", "f8"),  # time at which it was raised [s since 1970]
        ("value", "f8"),  # value at which it was raised; NaN without a number
    ],
    align=True,
)
"""Change of an alarm."""


@njit(cache=True)
def update(
    s: Record,
    d: Record,
    p: Record,
    b: Record,
    log: Records,
    k: int,
    at_s: float,
    step_s: float,
    measured: float,
    is_uncertain: int,
) -> None:
    """Process a value of an alarm.

    Args:
        s: State of the alarm, a record of dtype ALARM.
        d: Its definition, a record of dtype LIMITS.
        p: Record of dtype SETTINGS.
        b: Record of dtype EVALUATION_IO.
        log: Receives the changes, dtype LOG.
        k: Position of the alarm.
        at_s: Time on the samples' clock [s].
        step_s: Interval since the previous value, which counts toward the delays [s].
        measured: Value in the unit of the limit; NaN (not measured) neither raises nor ends the alarm.
        is_uncertain: 1: the true value may be beyond the limit. It neither ends the alarm nor its delay, unless the alarm was
            acknowledged at such a value and no measured one has been beyond the limit since.
    """
    if not d.monitored:
        return
    value, limit = d.sign * measured, d.sign * d.limit
    if value >= limit:  # uncertain values after this measured one need another acknowledgment
        s.is_uncertain, s.accepts_uncertain = 0, 0
    else:
        s.is_uncertain = is_uncertain
        if is_uncertain and (not s.accepts_uncertain if s.raised else s.holds):
            value = limit
    if math.isnan(value):
        s.missing_s += step_s
        return
    s.has_value = 1
    if s.missing_s < p.lost_s:
        step_s += s.missing_s
    s.missing_s = 0.0
    waits_for_end = s.raised and not s.cause_cleared
    if not (value < d.sign * d.clear if waits_for_end else value >= limit):
        s.holds, s.held_s = 0, 0.0
        return
    s.held_s = s.held_s + step_s if s.holds else 0.0
    s.holds = 1
    if s.held_s < (d.clear_delay_s if waits_for_end else d.delay_s):
        return
    s.holds, s.held_s = 0, 0.0
    _next_state(s, d, b, log, k, at_s, value)


@njit(cache=True)
def _next_state(s: Record, d: Record, b: Record, log: Records, k: int, at_s: float, value: float) -> None:
    """Change to the next state after its delay. ``value`` is multiplied by ``d.sign``; ``update`` describes the others."""
    if not s.raised:
        raise_now(s, d, b, log, k, at_s, at_s + b.wall_offset_s, d.sign * value if math.isfinite(value) else math.nan)
    elif s.cause_cleared:  # the cause has returned
        s.cause_cleared = 0
    elif d.latch and not s.acknowledged:
        s.cause_cleared = 1
    else:
        _end(s, b, log, k, at_s)


@njit(cache=True)
def raise_now(s: Record, d: Record, b: Record, log: Records, k: int, at_s: float, since_s: float, value: float) -> None:
    """Raise an alarm without its delay, if it is monitored and not raised.

    Args:
        s: State of the alarm, a record of dtype ALARM.
        d: Its definition, a record of dtype LIMITS.
        b: Record of dtype EVALUATION_IO.
        log: Receives the change, dtype LOG.
        k: Position of the alarm.
        at_s: Time on the samples' clock [s].
        since_s: Time on the wall clock [s since 1970].
        value: Value in the unit of the limit; NaN without a number.
    """
    if d.monitored and not s.raised:
        s.raised, s.holds, s.since_s, s.value, s.held_s = 1, 0, since_s, value, 0.0
        write_log(b, log, k, RAISED, at_s, since_s, value)


@njit(cache=True)
def acknowledge(alarms: Records, io: Records, log: Records, k: int, at_s: float) -> None:
    """Acknowledge raised alarm ``k`` at ``at_s`` on the samples' clock [s]. It ends now if its cause is gone."""
    s = alarms[0].states[k]
    s.acknowledged, s.accepts_uncertain = 1, s.is_uncertain
    if s.cause_cleared and s.holds:  # the cause has returned, and the delay runs
        s.cause_cleared, s.holds, s.held_s = 0, 0, 0.0
    if s.cause_cleared:
        _end(s, io[0], log, k, at_s)


@njit(cache=True)
def _end(s: Record, b: Record, log: Records, k: int, at_s: float) -> None:
    s.raised, s.cause_cleared, s.acknowledged, s.accepts_uncertain = 0, 0, 0, 0
    s.holds, s.since_s, s.value, s.held_s = 0, 0.0, 0.0, 0.0
    write_log(b, log, k, ENDED, at_s, 0.0, math.nan)


@njit(cache=True)
def write_log(b: Record, log: Records, k: int, kind: int, at_s: float, since_s: float, value: float) -> None:
    """Append a change of alarm ``k`` to the log; no effect if the log is full."""
    if b.logged < log.shape[0]:
        entry = log[b.logged]
        entry.alarm, entry.kind, entry.at_s, entry.since_s, entry.value = k, kind, at_s, since_s, value
        b.logged += 1
