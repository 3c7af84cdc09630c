"""Step of the estimators of all cells of a pack: windows of samples, and one update of each cell for each window."""

import math

import numpy as np

from bms_estimator.kernels.cells.cell_filter import (
    BALANCING_C,
    BALANCING_SPREAD_V,
    CURVE_STDS,
    CURVE_WINDOWS,
    HOUR_S,
    apply_changes,
    correct_cell,
    curve_variance,
    deviation_and_slope,
    initialize_cell,
    is_steep_near_full,
    noise_variance,
    predict_cell,
    predict_hypotheses,
    restart_hypothesis,
    update_hypotheses,
    write_ph,
)
from bms_estimator.kernels.cells.reading_faults import (
    ALIVE_V,
    JUMP_S,
    STUCK_V,
    end_fault,
    examine_reading,
    is_jump,
    mark_sense_wires,
    missed_change_v,
)
from bms_estimator.kernels.cells.records import FALL, RISE, SOC, STATES, ReadingFault
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.numba_cache import njit

WINDOW_S = 10.0
"""Minimum duration of a window [s]. Its means suppress noise and the delay between the readings of current and cells."""
MAX_STEP_S = 60.0
"""Maximum time between two samples over which the current counts as measured [s]."""
NEW_TIME_BASE_S = 1e9
"""Minimum difference between two times that shows another time base [s]: 30 years."""
NEAR_FULL_SOC = 0.1
"""After a cell was nearly full, and if the OCV curve is steep there, the cells are not compared until this charge has flowed, in
either direction [SOC]."""
NEAR_FULL_STD = 0.03
"""Minimum std of a cell's SOC while the cells are not compared."""
MIN_CELL_SOC, MAX_CELL_SOC = -0.2, 1.2
"""Range of the SOC of a cell that is over-discharged or overcharged."""
_NONE, _STUCK = int(ReadingFault.NONE), int(ReadingFault.STUCK)


@njit(cache=True)
def run_cells(
    cells: Records,
    bank: Records,
    filter_settings: Records,
    balancing_v: float,
    times_s: Floats,
    cells_v: Floats,
    trace: Records,
    scratch: Floats,
) -> None:
    """Process a block of samples. Processing starts with the first sample in which at most one cell voltage is missing.

    Args:
        cells: Shape (m,), dtype CELL; updated.
        bank: State that all cells share, shape (1,), dtype BANK_STATE; updated.
        filter_settings: Shape (1,), dtype EKF_SETTINGS.
        balancing_v: Cell voltage from which a balancer may be active [V].
        times_s: Times of the samples [s], shape (n,).
        cells_v: Cell voltages [V], shape (n, m).
        trace: Trace rows of the accepted samples, dtype TRACE.
        scratch: Shape (2 m + STATES,); overwritten.
    """
    r = 0
    for j in range(times_s.size):
        if r == trace.size:
            return
        if times_s[j] != trace[r].time_s:  # the sample was rejected
            continue
        row = trace[r]
        r += 1
        # one missing voltage is allowed, because a wire may be broken from the start
        if not (bank[0].started or np.isfinite(cells_v[j]).sum() >= cells.size - 1):
            continue
        if add_sample(cells, bank[0], filter_settings[0], cells_v[j], row) and bank[0].elapsed_s >= WINDOW_S:
            update_cells(cells, bank[0], filter_settings[0], balancing_v, row.soc, row.soc_std, scratch)


@njit(cache=True)
def add_sample(cells: Records, b: Record, p: Record, cells_v: Floats, row: Record) -> bool:
    """Add a sample to the window. Return False if the pack's filter has no estimate.

    ``b`` is a record of BANK_STATE, ``p`` of EKF_SETTINGS, ``row`` of TRACE.
    """
    if not math.isfinite(row.soc + row.soc_std + row.r_s_ohm + row.r_ts_ohm + row.r_tl_ohm):
        return False
    current_a = row.current_a
    if not b.started:
        for i in range(cells.size):
            initialize_cell(cells[i])
        b.started, b.time_s, b.soc, b.x_ts_a, b.x_tl_a = 1, row.time_s, row.soc, current_a, current_a
    dt_s = row.time_s - b.time_s
    if not 0.0 <= dt_s < NEW_TIME_BASE_S:  # another time base
        dt_s = b.unseen_s
    b.unseen_s = 0.0
    if dt_s > MAX_STEP_S:
        b.gap, held_a, change_soc = 1, 0.0, row.soc - b.soc
    else:
        held_a = current_a
        change_soc = -0.5 * (b.current_a + current_a) * dt_s / p.capacity_as
    b.x_ts_a = held_a + (b.x_ts_a - held_a) * math.exp(-dt_s / row.tau_ts_s)
    b.x_tl_a = held_a + (b.x_tl_a - held_a) * math.exp(-dt_s / row.tau_tl_s)
    b.time_s, b.current_a, b.soc = row.time_s, current_a, row.soc
    b.elapsed_s += dt_s
    b.change += change_soc
    b.throughput += abs(change_soc)
    b.sum_a += current_a
    b.sum_drop_v += (row.r_s_ohm * current_a + row.r_ts_ohm * b.x_ts_a + row.r_tl_ohm * b.x_tl_a) / p.series
    b.samples += 1
    for i in range(cells.size):
        if math.isfinite(cells_v[i]):
            cells[i].sum_v += cells_v[i]
            cells[i].samples += 1
    return True


@njit(cache=True)
def update_cells(
    cells: Records, b: Record, p: Record, balancing_v: float, soc: float, soc_std: float, scratch: Floats
) -> None:
    """Update all cells by the means of a window, and begin the next window.

    ``b`` is a record of BANK_STATE, ``p`` of EKF_SETTINGS. ``soc`` and ``soc_std`` are the pack's SOC at the end of the window
    and its std. ``run_cells`` describes ``cells``, ``balancing_v`` and ``scratch``.
    """
    m = cells.size
    voltages_v, errors_v, ph = scratch[:m], scratch[m : 2 * m], scratch[2 * m : 2 * m + STATES]
    current_a, drop_v = b.sum_a / b.samples, b.sum_drop_v / b.samples
    lowest_v, highest_v = math.inf, 0.0
    for i in range(m):
        c = cells[i]
        voltages_v[i] = c.sum_v / c.samples if c.samples else math.nan
        if c.samples and c.fault == _NONE:
            lowest_v, highest_v = min(lowest_v, voltages_v[i]), max(highest_v, voltages_v[i])
    balancing = highest_v >= balancing_v and current_a <= 0.0
    b.near_full_soc = max(b.near_full_soc - b.throughput, 0.0)
    if highest_v >= balancing_v and is_steep_near_full(p):
        b.near_full_soc = NEAR_FULL_SOC
    near_full = b.near_full_soc > 0.0
    balancing_variance = balancing_soc_variance(b, balancing)
    for i in range(m):
        may_be_drained = voltages_v[i] > lowest_v + BALANCING_SPREAD_V
        predict_cell(cells[i], b, balancing_variance if may_be_drained else 0.0)
        predict_hypotheses(cells[i], b, balancing)
        errors_v[i] = voltages_v[i] - deviation_and_slope(cells[i], p, soc, drop_v)[0]
    reference_v, median_v = median(errors_v, cells), median(voltages_v, cells)
    for i in range(m):
        if math.isfinite(voltages_v[i]) and math.isfinite(reference_v):
            slope_v = deviation_and_slope(cells[i], p, soc, drop_v)[1]
            curve_v2 = curve_variance(cells[i], p, soc, soc_std)
            # the factor CURVE_WINDOWS prevents that averaging over as many windows reduces the error of the OCV curve
            variance_v2 = noise_variance(drop_v) + CURVE_WINDOWS * curve_v2 + write_ph(cells[i], slope_v, drop_v, ph)
            innovation_v = errors_v[i] - reference_v
            ignored_v = missed_change_v(cells[i], voltages_v[i], median_v)
            update_cell(
                cells[i],
                b,
                slope_v,
                drop_v,
                innovation_v,
                variance_v2,
                curve_v2,
                balancing,
                near_full,
                current_a,
                ph,
                ignored_v,
            )
        if not math.isfinite(cells[i].mean.sum() + cells[i].covariance.sum()):
            initialize_cell(cells[i])
        cells[i].mean[SOC] = min(max(cells[i].mean[SOC], MIN_CELL_SOC - soc), MAX_CELL_SOC - soc)
        cells[i].sum_v, cells[i].samples = 0.0, 0
    mark_sense_wires(cells)
    b.windows += 1
    b.samples = b.gap = 0
    b.elapsed_s = b.change = b.throughput = b.sum_a = b.sum_drop_v = 0.0


@njit(cache=True)
def update_cell(
    c: Record,
    b: Record,
    slope_v: float,
    drop_v: float,
    innovation_v: float,
    variance_v2: float,
    curve_v2: float,
    balancing: bool,
    near_full: bool,
    current_a: float,
    ph: Floats,
    ignored_v: float,
) -> None:
    """Correct a cell's state, unless its reading is faulty.

    Args:
        c: The cell; updated.
        b: Window, dtype BANK_STATE.
        slope_v: Derivative of the deviation by the cell's SOC [V].
        drop_v: Overpotential of the reference cell [V].
        innovation_v: Innovation [V].
        variance_v2: Variance S of the innovation [V^2].
        curve_v2: Part of R that the curvature of the OCV causes [V^2].
        balancing: True if a balancer may be active.
        near_full: True if the cells are not compared, because one was nearly full.
        current_a: Mean current of the window [A].
        ph: P H', shape (STATES,).
        ignored_v: Change of the other cells' voltage to which the reading has not responded [V].
    """
    if ignored_v > STUCK_V or (c.fault == _STUCK and ignored_v > 0.0):  # 0: the reading has changed in this window
        c.fault, c.error_v = _STUCK, max(abs(innovation_v), STUCK_V)
        return
    if c.fault == _STUCK:
        end_fault(c)
    # variance in one window, in which the error of the curve counts once
    window_v2 = variance_v2 - (CURVE_WINDOWS - 1.0) * curve_v2
    if c.suspect_s > 0.0 or (is_jump(c, innovation_v, window_v2, CURVE_STDS * math.sqrt(curve_v2)) and not b.gap):
        examine_reading(c, innovation_v, current_a, b.elapsed_s, window_v2, ignored_v < ALIVE_V)
        return
    c.innovation_v += (1.0 - math.exp(-b.elapsed_s / JUMP_S)) * (innovation_v - c.innovation_v)
    if near_full:
        c.covariance[SOC, SOC] = max(c.covariance[SOC, SOC], NEAR_FULL_STD**2)
        # DRAIN is not restarted: its response grows while a balancer may be active, as when cells are nearly full
        restart_hypothesis(c, RISE)
        restart_hypothesis(c, FALL)
        return
    update_hypotheses(c, slope_v, drop_v, innovation_v, variance_v2, balancing, ph)
    correct_cell(c, innovation_v, variance_v2, ph)
    apply_changes(c)


@njit(cache=True)
def balancing_soc_variance(b: Record, active: bool) -> float:
    """Return the variance that a possible balancer adds to a cell's SOC in the window ``b``, dtype BANK_STATE.

    A balancer drains the same cells for hours. The std therefore grows in proportion to the time.
    """
    if not active:
        b.balancing_s = 0.0
        return 0.0
    before_s = b.balancing_s
    b.balancing_s += b.elapsed_s
    return (BALANCING_C / HOUR_S) ** 2 * (b.balancing_s**2 - before_s**2)


@njit(cache=True)
def median(values: Floats, cells: Records) -> float:
    """Return the median of the finite values of cells without a faulty reading; NaN for fewer than two values.

    The median is found by counting, because a sorted copy would need memory. ``values`` has shape (m,).
    """
    count = 0
    for i in range(values.size):
        count += math.isfinite(values[i]) and cells[i].fault == _NONE
    if count < 2:
        return math.nan
    return 0.5 * (ranked(values, cells, (count - 1) // 2) + ranked(values, cells, count // 2))


@njit(cache=True)
def ranked(values: Floats, cells: Records, rank: int) -> float:
    """Return the value of rank ``rank``, from 0 for the smallest, among the finite values of cells without a faulty reading."""
    for i in range(values.size):
        if math.isfinite(values[i]) and cells[i].fault == _NONE:
            smaller = equal = 0
            for j in range(values.size):
                if math.isfinite(values[j]) and cells[j].fault == _NONE:
                    smaller += values[j] < values[i]
                    equal += values[j] == values[i]
            if smaller <= rank < smaller + equal:
                return values[i]
    return math.nan
