"""Mean and largest current of each second since the last long charge, in a ring buffer.

``load`` is a record of LOAD.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import TAU_S
from bms_estimator.kernels.kalman_filter.ekf import CHARGE_C, CHARGE_PAIR
from bms_estimator.kernels.kalman_filter.window import REST_C
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.numba_cache import njit

MAX_LOAD_S = 20_000
"""Capacity of the ring buffer [s]: about 5.5 hours of use, in 160 kB."""
MAX_STORED_REST_S = 4000
"""Maximum length of a rest in the ring buffer [s]. Later seconds of the rest are not stored, because they would displace the
load before the rest."""
CHARGE_WEIGHT = 1.0 - math.exp(-1.0 / TAU_S[CHARGE_PAIR])
"""Weight of a new second in the filtered current that distinguishes a charge from regeneration."""

LOAD = np.dtype(
    [
        ("started", "i8"),  # 1: there is a previous row
        ("time_s", "f8"),  # time stamp of the previous row [s]
        ("current_a", "f8"),  # current of the previous row [A]
        ("part_s", "f8"),  # elapsed part of the present second [s]
        ("part_as", "f8"),  # charge of the present second until now [A s]
        ("part_max_a", "f8"),  # largest current of the present second until now [A]
        ("filtered_a", "f8"),  # current, filtered with the time constant ``TAU_S[CHARGE_PAIR]`` [A]
        ("last_a", "f8"),  # mean current of the last complete second [A]
        ("rest_s", "i8"),  # duration of the present rest [s]
        ("seen_discharge_a", "f8"),  # largest mean current of a second so far [A], at least 0
        ("seen_charge_a", "f8"),  # largest mean charge current of a second so far [A], at least 0
        ("count", "i8"),  # number of seconds in the ring buffer
        ("next", "i8"),  # index of the next second in the ring buffer
        ("mean_a", "f4", MAX_LOAD_S),  # mean current of each second [A]
        ("max_a", "f4", MAX_LOAD_S),  # largest current of each second [A]
    ],
    align=True,
)
"""Observed load: the stored seconds, and the present incomplete one."""


@njit(cache=True)
def add_rows(load: Record, rows: Records, unmeasured_s: float, one_c_a: float) -> None:
    """Add rows of the trace. The current is linear between two rows.

    A gap or a clock that was set back contributes no time.

    Args:
        load: Record of LOAD; updated.
        rows: Shape (n,), dtype TRACE.
        unmeasured_s: Longest step over which the current counts as measured [s].
        one_c_a: Current that empties the pack in an hour [A].
    """
    for j in range(rows.shape[0]):
        time_s, current_a = rows[j].time_s, rows[j].current_a
        step_s = time_s - load.time_s if load.started else math.inf
        if 0.0 < step_s <= unmeasured_s:
            add_step(load, step_s, 0.5 * (load.current_a + current_a), current_a, one_c_a)
        elif step_s != 0.0:
            begin_second(load)
        load.started, load.time_s, load.current_a = 1, time_s, current_a


@njit(cache=True)
def begin_second(load: Record) -> None:
    """Begin a new second. An incomplete one is discarded."""
    load.part_s, load.part_as, load.part_max_a = 0.0, 0.0, -math.inf


@njit(cache=True)
def add_step(load: Record, step_s: float, mean_a: float, end_a: float, one_c_a: float) -> None:
    """Divide a step between two rows among the seconds that it spans.

    All these seconds receive the mean current of the step, for their mean and for their largest current. The second that
    contains the end of the step also receives ``end_a`` [A] for its largest current.
    """
    while load.part_s + step_s >= 1.0:
        part_s = 1.0 - load.part_s
        step_s -= part_s
        largest_a = max(
            load.part_max_a, mean_a, end_a if step_s <= 0.0 else mean_a
        )  # rounding may make step_s negative
        add_second(load, load.part_as + mean_a * part_s, largest_a, one_c_a)
        begin_second(load)
    if step_s > 0.0:
        load.part_s += step_s
        load.part_as += mean_a * step_s
        load.part_max_a = max(load.part_max_a, mean_a, end_a)


@njit(cache=True)
def add_second(load: Record, mean_a: float, max_a: float, one_c_a: float) -> None:
    """Add a complete second, unless it belongs to a charge, to a rest after a charge, or to a long rest.

    A long charge empties the ring buffer. The first second of discharge ends the charge.
    """
    load.last_a = mean_a
    load.seen_discharge_a = max(load.seen_discharge_a, mean_a)
    load.seen_charge_a = max(load.seen_charge_a, -mean_a)
    load.filtered_a += CHARGE_WEIGHT * (mean_a - load.filtered_a)
    load.rest_s = load.rest_s + 1 if abs(mean_a) <= REST_C * one_c_a else 0
    if load.filtered_a < -CHARGE_C * one_c_a:
        load.count = 0
        if mean_a > REST_C * one_c_a:
            load.filtered_a = 0.0
    if load.rest_s > MAX_STORED_REST_S or (load.count == 0 and mean_a <= REST_C * one_c_a):
        return
    # the mean of a constant current may be above it by a rounding error
    load.mean_a[load.next], load.max_a[load.next] = mean_a, max(mean_a, max_a)
    load.next = (load.next + 1) % MAX_LOAD_S
    load.count = min(load.count + 1, MAX_LOAD_S)


@njit(cache=True)
def copy_seconds(load: Record, mean_a: Floats, max_a: Floats) -> None:
    """Write the stored seconds to arrays of shape (load.count,), oldest first [A]."""
    first = (load.next - load.count) % MAX_LOAD_S
    for j in range(load.count):
        at = (first + j) % MAX_LOAD_S
        mean_a[j], max_a[j] = load.mean_a[at], load.max_a[at]
