"""Measured quantities: values that the alarms compare with their limits, values that cannot be true, and lost quantities.

The alarms of a lost quantity cannot be watched.

``a`` is a record of ALARMS, ``p`` of SETTINGS, ``b`` of EVALUATION_IO, ``s`` of ALARM, ``d`` of LIMITS, ``x`` of SAMPLE.
``cells`` is the number of measured cell voltages, and ``low_v``, ``high_v`` and ``mean_v`` are their minimum, maximum and
mean [V].
"""

import math

from bms_estimator.kernels.alarms.records import (
    CELLS,
    CURRENT,
    LINK_LOST,
    QUANTITIES,
    SENSOR_FAULT,
    TEMPERATURE,
    VOLTAGE,
    WATCH_CHANGED,
    raise_now,
    write_log,
)
from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import MAX_CELL_V, Floats, Record, Records, SampleStatus
from bms_estimator.numba_cache import njit

MAX_SPACING_FRACTION = 0.5
"""Values of an intermittent sensor end a loss if their intervals are at most this fraction of ``lost_s``. It is below 1, so that
a sensor that is almost lost again remains lost."""
MIN_RESTORED_S = 10.0
"""A loss ends after values have arrived for this time, or for ``lost_s`` if that is longer [s]. A loose wire must not make a
relay chatter."""
RECENT_STEPS = 4.0
"""Maximum time between two intervals above ``gap_s`` that count as regular, in multiples of the longer interval."""
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
_VOLTAGE_SATURATED, _CURRENT_SATURATED = int(SampleStatus.VOLTAGE_SATURATED), int(SampleStatus.CURRENT_SATURATED)
_PROBE_FAULT = int(SampleStatus.PROBE_FAULT)


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


@njit(cache=True)
def cell_extremes(cells_v: Floats, j: int, n: int) -> tuple[float, float, int, float]:
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
def possible_values(
    p: Record, x: Record, low_v: float, high_v: float, cells: int, mean_v: float
) -> tuple[float, float, int]:
    """Return voltage [V] and current [A], NaN if they cannot be true of a pack, and the bits of impossible quantities."""
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
    is_milli = MILLI * p.low_v <= x.voltage_v <= MILLI * p.high_v  # then the current has the wrong unit, too
    if abs(x.current_a) > (p.range_a if is_milli else p.max_a) and not x.status & _CURRENT_SATURATED:
        bad |= 1 << CURRENT
        current_a = math.nan
    return voltage_v, current_a, bad


@njit(cache=True)
def measured_values(
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
    out[2], out[3], out[4] = high_v, low_v, high_v - low_v if high_v < p.steep_v else math.nan
    out[5], out[6] = current_a, -current_a
    out[7], out[8], out[9] = hottest_c, coldest_c, charging_c
    out[LINK_LOST] = passed_s if observed_s < passed_s else 0.0  # duration of the gap before the sample; 0: no gap


@njit(cache=True)
def uncertain_values(
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

    Bit k belongs to ``NAMES[k]``. Heat destroys probes. A broken wire hides a voltage or lets it float to an end of the range.
    A dead current sensor reads an end of its range.
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
def count_values(
    p: Record,
    x: Record,
    voltage_v: float,
    current_a: float,
    cells: int,
    bad: int,
    cells_unusable: int,
    out: Floats,
    j: int,
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
    if cells_unusable and not cells:
        bad |= 1 << CELLS
    if x.status & _PROBE_FAULT and math.isnan(x.temperature_c):  # missing, also if it was never measured
        bad |= 1 << TEMPERATURE
    for q in range(QUANTITIES):
        if bad >> q & 1:
            out[1 + q, j] = -1.0
