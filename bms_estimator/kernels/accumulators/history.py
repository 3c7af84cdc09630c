"""Rows of the pack's history: means over periods with one direction of the current and a limited charge.

The slow fit (``bms_estimator.pack_model``) estimates the pack's OCV curve, capacity and resistances from these rows. Means
suffice, because the voltage is linear in the filtered currents of the RC pairs and in the hysteresis.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, TREND_PAIR
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

ROW_SOC = 0.02
"""Maximum charge of a row [SOC]. Over this charge OCV and resistances are nearly linear in SOC."""
MIN_ROW_S = 20.0
"""Minimum duration of a row [s]. Shorter rows have hardly any information and are discarded."""
MAX_ROW_S = 4.0 * 3600.0
"""Maximum duration of a row [s]."""
FIRST_REST_S = 60.0
"""Maximum duration of the first row of a rest [s]. Relaxation is fast at first, so that later rows may be longer."""
REST_GROWTH = 0.5
"""Maximum duration of a later row of a rest, as a fraction of the time since the rest began."""
DIRECTION_C = 0.015
"""Minimum current of a discharge or a charge, filtered over 120 s (``x_a[TREND_PAIR]``), as a C-rate."""
HYSTERESIS_SOC = 0.03, 0.15
"""Charge constants of the exponential approach of the fast and the slow part of the hysteresis to -1 or 1 [SOC]."""
MAX_ROWS = 16
"""Number of completed rows that the state can hold."""
MIN_FREE_ROWS = 3
"""Number of free rows at which the caller must take the completed ones. One sample may complete three rows: at a change of
direction, at a known SOC, and at a gap."""

HISTORY_ROW = np.dtype(
    [
        ("elapsed_s", "f8"),  # mean time since the history began [s]
        ("duration_s", "f8"),  # duration of the row [s]; 0: only ``reference_soc`` is valid
        ("segment", "f8"),  # number of the segment: a period without gaps in which a charge may have flowed unmeasured
        ("gap_s", "f8"),  # duration of the gap before the segment [s]; infinite if unknown
        ("direction", "f8"),  # 1 discharge, 0 rest, -1 charge
        ("voltage_v", "f8"),
        ("current_a", "f8"),  # positive on discharge
        ("between_a2", "f8"),  # variance of ``current_a``: the current between slow samples is unknown [A^2]
        ("skew_a2", "f8"),  # variance of ``current_a``: voltage and current are not measured at the same time [A^2]
        ("x_a", "f8", BRANCHES),  # current filtered by the RC pairs since their last reset [A]
        ("settled_s", "f8"),  # time from the reset of the RC pairs to the start of the row [s]
        ("temperature_c", "f8"),
        ("charge_as", "f8"),  # charge since the last sample before the segment, positive on discharge [A s]
        ("charge_variance_as2", "f8"),  # variance of that charge by rounding, interpolation and short gaps [A^2 s^2]
        ("throughput_soc", "f8"),  # sum of charge and discharge since the segment began [SOC]
        ("hysteresis", "f8", 2),  # fast and slow part, -1..1; 0 at the start of the segment
        ("soc", "f8"),  # SOC of the filter
        ("reference_soc", "f8"),  # known SOC, such as at the end of a charge; NaN: none
        ("reference_kind", "f8"),  # 1: end of a charge, 2: end of a discharge, 0: set by the user
        ("reference_std", "f8"),  # std of reference_soc
    ],
    align=True,
)
"""Row of the history. Values are means over the row unless stated otherwise."""

HISTORY = np.dtype(
    [
        ("enabled", "i8"),  # 1: rows are recorded
        ("elapsed_s", "f8"),  # time since the history began [s]
        ("event_s", "f8"),  # elapsed_s at which ``kernels.step.run`` returns, for example to begin a fit [s]
        ("segment", "i8"),
        ("gap_s", "f8"),
        ("direction", "i8"),
        ("direction_s", "f8"),  # time for which the direction has not changed [s]
        ("charge_as", "f8"),
        ("charge_variance_as2", "f8"),
        ("throughput_soc", "f8"),
        ("row_as", "f8"),  # charge since the present row began [A s]
        ("hysteresis", "f8", 2),
        ("sums", HISTORY_ROW),  # sums of the present row, weighted by time
        ("rows", HISTORY_ROW, MAX_ROWS),  # completed rows
        ("count", "i8"),  # number of completed rows
    ],
    align=True,
)
"""State of the recording of history rows."""


@njit(cache=True)
def begin_segment(h: Record, gap_s: float, charge_as: float, std_as: float) -> None:
    """Begin a new segment after a gap that may hide a charge.

    Args:
        h: Record of HISTORY.
        gap_s: Duration of the gap [s]; infinite if unknown.
        charge_as: Expected charge in the gap, positive on discharge [A s].
        std_as: Std of that charge [A s].
    """
    if gap_s < math.inf:
        h.elapsed_s += gap_s
    if h.enabled == 0:
        return
    complete_row(h)
    h.segment += 1
    h.gap_s, h.charge_as, h.charge_variance_as2 = gap_s, charge_as, std_as * std_as
    h.throughput_soc = h.direction_s = 0.0
    h.hysteresis[:] = 0.0
    h.direction = 0


@njit(cache=True)
def add_window(h: Record, f: Record, p: Record) -> None:
    """Add the filter's window of about a second to the present row.

    Args:
        h: Record of HISTORY.
        f: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
    """
    w, dt_s = f.window, f.window.time_s
    h.elapsed_s += dt_s
    if h.enabled == 0 or dt_s <= 0.0:
        return
    count_window(h, f, p)
    if w.gap:  # the mean voltage of a window with a gap belongs to its last samples only
        complete_row(h)
        return
    direction = direction_of(f.x_a[TREND_PAIR], p.capacity_as / 3600.0)
    if direction != h.direction or row_is_complete(h, p):
        complete_row(h)
        if direction != h.direction:
            h.direction, h.direction_s = direction, 0.0
    h.direction_s += dt_s
    h.row_as += w.charge_as
    r, n = h.sums, w.samples
    if r.duration_s == 0.0:
        r.settled_s = f.seeded_s  # the RC pairs were reset when the hypotheses were initialized
    r.duration_s += dt_s
    r.elapsed_s += dt_s * h.elapsed_s
    r.voltage_v += dt_s * w.sum_v / n
    r.current_a += dt_s * w.sum_a / n
    r.between_a2 += w.between_as2
    r.skew_a2 += dt_s * dt_s * w.skew_a2 / (n * n)
    r.temperature_c += dt_s * f.temperature_c
    r.charge_as += dt_s * h.charge_as
    r.throughput_soc += dt_s * h.throughput_soc
    r.soc += dt_s * f.soc
    for k in range(BRANCHES):
        r.x_a[k] += dt_s * w.sum_x_a[k] / n
    for k in range(2):
        r.hysteresis[k] += dt_s * h.hysteresis[k]


@njit(cache=True)
def count_window(h: Record, f: Record, p: Record) -> None:
    """Count charge, variance of the charge, and hysteresis over the window."""
    w = f.window
    h.charge_as += w.charge_as
    h.throughput_soc += w.throughput_as / p.capacity_as
    h.charge_variance_as2 += w.between_as2 + w.rounded_as2 + w.unknown_as * w.unknown_as
    moved_soc = f.x_a[TREND_PAIR] * w.time_s / p.capacity_as
    for k in range(2):
        share = 1.0 - math.exp(-abs(moved_soc) / HYSTERESIS_SOC[k])
        h.hysteresis[k] -= share * (h.hysteresis[k] + math.copysign(1.0, moved_soc))


@njit(cache=True)
def direction_of(current_a: float, one_c: float) -> int:
    """Return 1 for a discharge, -1 for a charge, 0 for a rest."""
    if abs(current_a) < DIRECTION_C * one_c:
        return 0
    return 1 if current_a > 0.0 else -1


@njit(cache=True)
def row_is_complete(h: Record, p: Record) -> bool:
    """Return True if the present row has its maximum charge or duration."""
    limit_s = MAX_ROW_S
    if h.direction == 0:
        limit_s = min(max(FIRST_REST_S, REST_GROWTH * h.direction_s), MAX_ROW_S)
    return abs(h.row_as) >= ROW_SOC * p.capacity_as or h.sums.duration_s >= limit_s


@njit(cache=True)
def complete_row(h: Record) -> None:
    """Store the means of the present row, unless it is too short, and begin a new row."""
    r = h.sums
    if r.duration_s >= MIN_ROW_S:
        row = append_row(h)
        scale = 1.0 / r.duration_s
        row.elapsed_s, row.duration_s, row.settled_s = scale * r.elapsed_s, r.duration_s, r.settled_s
        row.direction = h.direction
        row.voltage_v, row.current_a = scale * r.voltage_v, scale * r.current_a
        row.between_a2, row.skew_a2 = scale * scale * r.between_a2, scale * scale * r.skew_a2
        row.temperature_c, row.soc = scale * r.temperature_c, scale * r.soc
        row.charge_as, row.throughput_soc = scale * r.charge_as, scale * r.throughput_soc
        for j in range(row.x_a.size):
            row.x_a[j] = scale * r.x_a[j]
        for j in range(row.hysteresis.size):
            row.hysteresis[j] = scale * r.hysteresis[j]
    r.duration_s = r.elapsed_s = r.settled_s = r.voltage_v = r.current_a = r.temperature_c = 0.0
    r.between_a2 = r.skew_a2 = r.charge_as = r.throughput_soc = r.soc = 0.0
    r.x_a[:] = 0.0
    r.hysteresis[:] = 0.0
    h.row_as = 0.0


@njit(cache=True)
def append_row(h: Record) -> Record:
    """Return the next row of the buffer, initialized without a known SOC. A full buffer loses its oldest row."""
    if h.count == MAX_ROWS:
        for j in range(MAX_ROWS - 1):
            h.rows[j] = h.rows[j + 1]
        h.count -= 1
    row = h.rows[h.count]
    h.count += 1
    row.segment, row.gap_s, row.charge_variance_as2 = h.segment, h.gap_s, h.charge_variance_as2
    row.reference_soc = row.reference_std = math.nan
    row.reference_kind = 0
    return row


@njit(cache=True)
def add_reference(h: Record, kind: int, soc: float, std: float) -> None:
    """Append a row with a known SOC. ``kind`` is a value of the field ``reference_kind``."""
    if h.enabled == 0:
        return
    complete_row(h)
    row = append_row(h)
    row.elapsed_s, row.duration_s, row.direction = h.elapsed_s, 0.0, h.direction
    row.voltage_v = row.current_a = row.temperature_c = row.settled_s = row.between_a2 = row.skew_a2 = 0.0
    row.charge_as, row.throughput_soc = h.charge_as, h.throughput_soc
    row.x_a[:] = 0.0
    for j in range(row.hysteresis.size):
        row.hysteresis[j] = h.hysteresis[j]
    row.soc, row.reference_soc, row.reference_kind, row.reference_std = soc, soc, kind, std


@njit(cache=True)
def needs_caller(h: Record) -> bool:
    """Return True if the caller must take the completed rows, or if ``event_s`` has passed."""
    return h.enabled != 0 and (h.count >= MAX_ROWS - MIN_FREE_ROWS or h.elapsed_s >= h.event_s)
