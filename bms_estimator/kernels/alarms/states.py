"""State machine of an alarm: hysteresis, delays and latch, on the samples' clock."""

import math

from bms_estimator.kernels.alarms.records import ENDED, RAISED
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit


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
