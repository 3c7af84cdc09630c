"""Values of a sample that the alarms compare with their limits, and values that cannot be true.

``p`` is a record of SETTINGS, ``x`` of SAMPLE. ``cells`` is the number of measured cell voltages, and ``low_v``, ``high_v`` and
``mean_v`` are their minimum, maximum and mean [V].
"""

import math

from bms_estimator.kernels.alarms.records import CELLS, CURRENT, LINK_LOST, QUANTITIES, TEMPERATURE, VOLTAGE
from bms_estimator.model.arrays import MAX_CELL_V, Floats, Record, SampleStatus
from bms_estimator.numba_cache import njit

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
