"""Rate error of the board's clock relative to the host's, from the smallest delays of its samples.

Line, USB bridge and scheduler delay a sample, but never advance it. Therefore only the sample with the smallest delay in
each ten seconds is used. The rate follows from the lower convex hull of these delays (Moon, Skelly, Towsley 1999). The
estimate is only reported; the times of the samples are not corrected.

``d`` is the state of the frame decoder, a record of ``framing.DECODER``.
"""

import math

import numpy as np

from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

CLOCK_WINDOWS = 60
"""Number of windows of 10 s. They span only ten minutes, because a resonator drifts with its temperature."""
_WINDOW_US = 10_000_000
"""Length of a window [us]."""
_MIN_US = 60_000_000
"""Minimum time for an estimate [us]. The smallest delays differ by up to 1 ms, which is 17 ppm of a minute."""
_US = 1e-6


@njit(cache=True)
def reset_clock_estimate(d: Record) -> None:
    """Reset the estimate of the board's clock."""
    d.clock_windows = 0


@njit(cache=True)
def add_arrival(d: Record, arrival_s: float) -> None:
    """Record the arrival of the sample at ``d.elapsed_us``."""
    if d.clock_windows == 0:
        d.clock_origin_s = arrival_s
    delay_s = arrival_s - d.clock_origin_s - d.elapsed_us * _US
    if d.clock_windows == 0 or d.elapsed_us - d.clock_begin_us >= _WINDOW_US:
        d.clock_windows += 1
        d.clock_begin_us = d.elapsed_us
    elif delay_s >= d.clock_late_s[(d.clock_windows - 1) % CLOCK_WINDOWS]:
        return
    window = (d.clock_windows - 1) % CLOCK_WINDOWS
    d.clock_at_us[window] = d.elapsed_us
    d.clock_late_s[window] = delay_s


@njit(cache=True)
def clock_ppm(d: Record) -> float:
    """Return the rate error of the board's clock relative to the host's [1e-6].

    NaN in the first minute, and if all samples arrived at the same time.
    """
    count = min(d.clock_windows, CLOCK_WINDOWS)
    at_s, delay_s = np.empty(count), np.empty(count)
    for i in range(count):
        window = (d.clock_windows - count + i) % CLOCK_WINDOWS
        at_s[i] = d.clock_at_us[window] * _US
        delay_s[i] = d.clock_late_s[window]
    if count < 2 or at_s[-1] - at_s[0] < _MIN_US * _US:
        return math.nan
    hull = np.empty(count, np.int64)
    hull_size = 0
    for i in range(count):
        while hull_size > 1 and _is_above(at_s, delay_s, hull[hull_size - 2], hull[hull_size - 1], i):
            hull_size -= 1
        hull[hull_size] = i
        hull_size += 1
    # of all edges of the hull, the one at the mean time has the smallest mean distance from all points
    mean_time_s, corner = at_s.mean(), 1
    while at_s[hull[corner]] < mean_time_s:
        corner += 1
    begin, end = hull[corner - 1], hull[corner]
    board_s = at_s[end] - at_s[begin]
    host_s = board_s + delay_s[end] - delay_s[begin]
    return (board_s / host_s - 1.0) * 1e6 if host_s > 0.0 else math.nan


@njit(cache=True)
def _is_above(x: np.ndarray, y: np.ndarray, begin: int, middle: int, end: int) -> bool:
    """Return True if the middle one of three points lies on or above the line through the others."""
    return bool((y[middle] - y[begin]) * (x[end] - x[begin]) >= (y[end] - y[begin]) * (x[middle] - x[begin]))
