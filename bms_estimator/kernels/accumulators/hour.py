"""Sums over the samples of one hour of a pack."""

import math

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import GAP_RATIO
from bms_estimator.model.arrays import Record, Records
from bms_estimator.numba_cache import njit

HOUR_SUMS = np.dtype(
    [
        ("store", "u8"),  # creation time of the edge's store that sent the last block [ns since 1970]; 0: no block yet
        ("last_s", "f8"),  # time stamp of the last sample [s]
        ("last_a", "f8"),  # current of the last sample [A]
        ("last_w", "f8"),  # power of the last sample [W]
        ("step_s", "f8"),  # time between the last two samples [s]
        ("rest_s", "f8"),  # duration of the present rest, without gaps [s]
        ("outliers_before", "i8"),  # outlier counter of the estimator at the start of the hour
        ("searches_before", "i8"),  # counter of SOC re-initializations at the start of the hour
        ("samples", "i8"),  # accepted samples; this field and all later ones restart with each hour (HOURLY_FIELDS)
        ("dropped", "i8"),  # rejected samples
        ("gaps", "i8"),  # steps over which charge and energy are not counted
        ("lost_blocks", "i8"),  # blocks that were never received
        ("seen_s", "f8"),  # measured time [s]
        ("out_as", "f8"),  # charge [A s] and energy [W s], separately for discharging (out) and charging (in) steps
        ("in_as", "f8"),
        ("out_ws", "f8"),
        ("in_ws", "f8"),
        ("sum_v", "f8"),
        ("min_v", "f8"),
        ("max_v", "f8"),
        ("sum_a", "f8"),
        ("min_a", "f8"),
        ("max_a", "f8"),
        ("temperatures", "i8"),  # samples with a temperature
        ("sum_c", "f8"),
        ("min_c", "f8"),
        ("max_c", "f8"),
        ("innovations", "i8"),  # samples with an innovation
        ("sum_innovation_v2", "f8"),
        ("min_margin", "f8"),  # soc - max(delta_1, delta_2), NaN if no sample has a margin
    ],
    align=True,
)
"""Running sums of an hour. All fields are 0 before the first sample."""
HOURLY_FIELDS = tuple(HOUR_SUMS.names or ())[(HOUR_SUMS.names or ()).index("samples") :]
"""Fields that restart with each hour."""


@njit(cache=True)
def accumulate_hour(sums: Records, trace: Records, new_clock: bool, gap_s: float, rest_a: float) -> None:
    """Add accepted samples to the sums of an hour.

    Args:
        sums: Shape (1,), dtype HOUR_SUMS; updated in place.
        trace: Shape (n,), dtype TRACE.
        new_clock: True if the time stamps have another time base than those of earlier blocks.
        gap_s: Minimum duration of a gap [s]. A gap is also longer than ``GAP_RATIO`` previous steps.
        rest_a: Maximum current that counts as zero [A].
    """
    h = sums[0]
    has_previous = h.store != 0 and not new_clock
    for j in range(trace.shape[0]):
        x = trace[j]
        add_step(h, x, has_previous, gap_s, rest_a)
        add_values(h, x)
        has_previous = True


@njit(cache=True)
def add_step(h: Record, x: Record, has_previous: bool, gap_s: float, rest_a: float) -> None:
    """Add charge, energy and time since the previous sample by the trapezoidal rule; count a gap instead if there is one.

    Args:
        h: Record of HOUR_SUMS.
        x: Record of TRACE.
        has_previous: True if a previous sample with the same time base exists.
        gap_s: Minimum duration of a gap [s]. A gap is also longer than ``GAP_RATIO`` previous steps.
        rest_a: Maximum current that counts as zero [A].
    """
    power_w, dt_s = x.voltage_v * x.current_a, x.time_s - h.last_s
    measured = has_previous and 0.0 < dt_s <= max(gap_s, GAP_RATIO * h.step_s)
    if measured:
        charge_as, energy_ws = 0.5 * dt_s * (h.last_a + x.current_a), 0.5 * dt_s * (h.last_w + power_w)
        h.seen_s += dt_s
        h.out_as += max(charge_as, 0.0)
        h.in_as += max(-charge_as, 0.0)
        h.out_ws += max(energy_ws, 0.0)
        h.in_ws += max(-energy_ws, 0.0)
    elif h.store != 0:
        h.gaps += 1
    h.step_s = dt_s if has_previous and dt_s > 0.0 else 0.0
    h.rest_s = h.rest_s + dt_s if measured and abs(x.current_a) <= rest_a else 0.0
    h.last_s, h.last_a, h.last_w = x.time_s, x.current_a, power_w


@njit(cache=True)
def add_values(h: Record, x: Record) -> None:
    """Add sample ``x``, a record of TRACE, to the sums and extremes of ``h``, a record of HOUR_SUMS."""
    first = h.samples == 0
    h.samples += 1
    h.sum_v += x.voltage_v
    h.min_v = x.voltage_v if first else min(h.min_v, x.voltage_v)
    h.max_v = x.voltage_v if first else max(h.max_v, x.voltage_v)
    h.sum_a += x.current_a
    h.min_a = x.current_a if first else min(h.min_a, x.current_a)
    h.max_a = x.current_a if first else max(h.max_a, x.current_a)
    h.min_margin = x.stability_margin if first else np.fmin(h.min_margin, x.stability_margin)
    if math.isfinite(x.innovation_v):
        h.innovations += 1
        h.sum_innovation_v2 += x.innovation_v * x.innovation_v
    if math.isfinite(x.temperature_c):
        has_extremes = h.temperatures > 0
        h.temperatures += 1
        h.sum_c += x.temperature_c
        h.min_c = min(h.min_c, x.temperature_c) if has_extremes else x.temperature_c
        h.max_c = max(h.max_c, x.temperature_c) if has_extremes else x.temperature_c
