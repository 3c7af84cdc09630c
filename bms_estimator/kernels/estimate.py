"""The way of one sample through the numbers: ``step`` takes it, ``run`` loops ``step`` over a block."""

import math
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bms_estimator.kernels.observer import observer_step, start
from bms_estimator.kernels.state import Record

Records = NDArray[np.void]


class Verdict(IntEnum):
    """What became of a sample."""

    ACCEPTED = 0
    NOT_FINITE = 1
    OUT_OF_RANGE = 2
    REPEATED = 3
    SATURATED = 4


_ACCEPTED = int(Verdict.ACCEPTED)
_NOT_FINITE = int(Verdict.NOT_FINITE)
_OUT_OF_RANGE = int(Verdict.OUT_OF_RANGE)
_REPEATED = int(Verdict.REPEATED)
_SATURATED = int(Verdict.SATURATED)
_VOLTAGE_SATURATED_BIT = 1  # SampleStatus.VOLTAGE_SATURATED


@njit(cache=True)
def judge(s: Record, p: Record, time_s: float, current_a: float, voltage_v: float, status: int) -> int:
    """Whether a sample can be used; counts those that cannot by their kind."""
    if not (math.isfinite(time_s) and math.isfinite(current_a) and math.isfinite(voltage_v)):
        s.dropped_not_finite += 1
        return _NOT_FINITE
    if status & _VOLTAGE_SATURATED_BIT:
        s.dropped_saturated += 1
        return _SATURATED
    if not (p.voltage_min_v <= voltage_v <= p.voltage_max_v and abs(current_a) <= p.current_max_a):
        s.dropped_range += 1
        return _OUT_OF_RANGE
    if s.started and time_s == s.time_s:
        s.dropped_repeated += 1
        return _REPEATED
    return _ACCEPTED


@njit(cache=True)
def step(state: Records, settings: Records, time_s: float, current_a: float, voltage_v: float, status: int) -> int:
    """Take one sample.

    Args:
        state: Shape (1,), dtype OBSERVER_STATE; updated in place.
        settings: Shape (1,), dtype OBSERVER_SETTINGS.
        time_s: Time stamp [s].
        current_a: Current [A], positive on discharge.
        voltage_v: Terminal voltage [V].
        status: Bits of ``SampleStatus``.

    Returns:
        A ``Verdict``.
    """
    s, p = state[0], settings[0]
    verdict = judge(s, p, time_s, current_a, voltage_v, status)
    if verdict != _ACCEPTED:
        return verdict
    s.samples += 1
    if not s.started:
        start(s, p, time_s, current_a, voltage_v)
        return verdict
    dt_s = time_s - s.time_s
    s.time_s = time_s
    if dt_s < 0.0:  # the clock was set back: go on from here
        s.time_steps_back += 1
        s.current_a = current_a
        return verdict
    if dt_s > p.gap_s:
        s.gaps += 1
    observer_step(s, p, dt_s, current_a, voltage_v)
    return verdict


@njit(cache=True)
def run(state: Records, settings: Records, samples: Records, trace: Records) -> int:
    """Take a block of samples: ``step`` for each, a row of ``trace`` for each accepted one.

    Args:
        state: As in ``step``.
        settings: As in ``step``.
        samples: Shape (n,), dtype SAMPLE.
        trace: Shape (m,) with m >= n, dtype TRACE; written from its start.

    Returns:
        How many rows of ``trace`` were written.
    """
    rows = 0
    for j in range(samples.shape[0]):
        x = samples[j]
        if step(state, settings, x.time_s, x.current_a, x.voltage_v, x.status) == _ACCEPTED:
            write_row(trace[rows], state[0], settings[0], x)
            rows += 1
    return rows


@njit(cache=True)
def write_row(row: Record, s: Record, p: Record, x: Record) -> None:
    """What there is to say of an accepted sample ``x``."""
    row.time_s = x.time_s
    row.voltage_v = x.voltage_v
    row.current_a = x.current_a
    row.temperature_c = x.temperature_c
    row.soc = s.soc
    row.voltage_estimate_v = s.voltage_estimate_v
    row.innovation_v = s.innovation_v
    row.nussbaum_gain = s.gain
    row.k = s.k
    row.delta_1 = s.delta_1
    row.delta_2 = s.delta_2
    row.stability_margin = s.soc - max(s.delta_1, s.delta_2)
    row.lock = s.lock
    row.converged = 1 if abs(s.innovation_v) < p.epsilon_v else 0
