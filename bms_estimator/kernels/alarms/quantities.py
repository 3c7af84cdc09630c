"""Intervals between samples, loss of measured quantities, and the alarms that cannot be watched because of it.

``a`` is a record of ALARMS, ``p`` of SETTINGS, ``b`` of EVALUATION_IO, ``s`` of ALARM, ``d`` of LIMITS.
"""

import math

from bms_estimator.kernels.alarms.records import QUANTITIES, SENSOR_FAULT, WATCH_CHANGED
from bms_estimator.kernels.alarms.states import raise_now, write_log
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.numba_cache import njit

MAX_SPACING_FRACTION = 0.5
"""Values of an intermittent sensor end a loss if their intervals are at most this fraction of ``lost_s``. It is below 1, so that
a sensor that is almost lost again remains lost."""
MIN_RESTORED_S = 10.0
"""A loss ends after values have arrived for this time, or for ``lost_s`` if that is longer [s]. A loose wire must not make a
relay chatter."""
RECENT_STEPS = 4.0
"""Maximum time between two intervals above ``gap_s`` that count as regular, in multiples of the longer interval."""


@njit(cache=True)
def step_intervals(s: Record, at_s: float, gap_s: float) -> tuple[float, float]:
    """Return the interval since the previous time, and the observed part of it, which is 0 for a gap [s].

    A gap is much longer than the longest recent interval. Samples that arrive in bursts have one long interval before each
    burst. From the second burst on, these intervals do not count as gaps.

    Args:
        s: Record of dtype INTERVALS; updated.
        at_s: The time [s].
        gap_s: Minimum length of a gap [s].
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
def update_quantities(
    alarms: Records,
    limits: Records,
    settings: Records,
    io: Records,
    samples: Records,
    scratch: Floats,
    log: Records,
    end_s: float,
) -> None:
    """Update the loss of measured quantities, and the alarms that cannot be watched because of it.

    ``end_s`` is the time of the last sample [s], and ``evaluate.evaluate`` describes the other arguments.
    """
    a, p = alarms[0], settings[0]
    changed_s = math.nan  # time of the first loss or end of a loss
    for q in range(QUANTITIES):
        for j in range(samples.shape[0]):
            step_s, count = scratch[0, j], int(scratch[1 + q, j])
            if step_s >= 0.0 and _step_quantity(a.quantities[q], step_s, count, p.lost_s) and math.isnan(changed_s):
                changed_s = samples[j].time_s
    update_unwatched(alarms, limits, io, log, end_s if math.isnan(changed_s) else changed_s)
    if not math.isnan(changed_s) and is_blinded(a.states, limits, lost_quantities(a)):
        # the delay of the alarm is skipped, because the quantity has been missing for ``lost_s`` already
        s, d, b = a.states[SENSOR_FAULT], limits[SENSOR_FAULT], io[0]
        raise_now(s, d, b, log, SENSOR_FAULT, changed_s, changed_s + b.wall_offset_s, math.nan)


@njit(cache=True)
def update_unwatched(alarms: Records, limits: Records, io: Records, log: Records, at_s: float) -> None:
    """Update the alarms that cannot be watched at ``at_s`` [s], because a quantity is lost or no samples arrive.

    ``evaluate.evaluate`` describes the other arguments. An alarm counts as watched if a quantity that it needs was never
    measured, because it could not be evaluated before either. A critical alarm whose delay runs stays unwatched, so that a
    relay does not close before the alarm is raised.
    """
    a, b = alarms[0], io[0]
    lost = lost_quantities(a)
    measured = lost  # a quantity of which all values were unusable is lost without a measured value
    for q in range(QUANTITIES):
        measured |= (a.quantities[q].max_count > 0) << q
    for k in range(a.states.shape[0]):
        s, d = a.states[k], limits[k]
        is_held = s.unwatched and d.critical and s.holds and not s.raised
        is_missing = d.needs & lost != 0 or (d.needs != 0 and b.is_silent != 0)
        unwatched = 1 if d.monitored and (is_held or (is_missing and not d.needs & ~measured)) else 0
        if unwatched != s.unwatched:
            s.unwatched = unwatched
            write_log(b, log, k, WATCH_CHANGED, at_s, 0.0, math.nan)


@njit(cache=True)
def lost_quantities(a: Record) -> int:
    """Return the bits of the lost quantities of a record of dtype ALARMS."""
    lost = 0
    for q in range(QUANTITIES):
        lost |= a.quantities[q].lost << q
    return lost


@njit(cache=True)
def is_blinded(states: Records, limits: Records, lost: int) -> bool:
    """Return True if a critical alarm is unwatched because of a lost quantity, of which ``lost`` has the bits."""
    result = False
    for k in range(states.shape[0]):
        result |= states[k].unwatched != 0 and limits[k].critical != 0 and limits[k].needs & lost != 0
    return result


@njit(cache=True)
def _step_quantity(s: Record, step_s: float, count: int, lost_s: float) -> bool:
    """Process the number of values of a quantity in a sample, negative for unusable ones. Return True if ``lost`` has changed.

    ``s`` is a record of QUANTITY.
    """
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
