"""Detection of a frozen voltage or current: a constant value that charge or load contradict.

A loose wire or a stuck converter causes such values. In CHECKS, ``held_*`` are values at or since the last change of the
voltage, and ``same_*`` are values at or since the last change of the current. ``slow_v`` and ``slow_a`` are running means over
``FAST_S`` or ``MEAN_SAMPLES``. ``slower_v`` is the running mean of ``slow_v``.

``c`` is a record of CHECKS, ``f`` of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

FAST_S = 10.0
"""Maximum interval between samples at which changes of voltage and current are compared, and minimum averaging time of the
slow means [s]."""
MEAN_SAMPLES = 3.0
"""Minimum averaging time of the slow means, in samples. With one sample, the means are as noisy as the voltage: noise alone
exceeds ``NOISE_STEPS`` in 6.6 % of samples, instead of 0.04 % with three."""
VISIBLE_V = 0.003
"""Change of the overpotential of one cell that a working sensor certainly shows [V]."""
SUSPECT_S = 5.0
"""Duration of an implausibly constant voltage after which the voltage is no longer used [s]."""
FROZEN_S = 60.0
"""Duration of an implausibly constant input after which the input is reported as frozen [s]."""
SWING_V = 0.02
"""Change of the voltage of one cell that proves a constant current frozen [V]."""
NOISE_STEPS = 4.0
"""A constant current is frozen only if the voltage changes by more than this multiple of its mean change between two samples.
Noise contributes to that mean at each sample and therefore does not exceed the limit. A load changes the voltage seldom."""
JUMP_SHARE = 0.125
"""Weight of a jump in the mean size of the jumps, so that the mean is over about eight. Changes above half of ``SWING_V`` are jumps."""
DITHER_SPREAD = 0.2
"""Relative std of the jumps below which they are dither. A converter's jumps have one size, and those of loads differ.
Jumps of more than twice ``SWING_V`` have another cause."""
MIN_RESOLUTION_STEPS = 3.0
"""Minimum change of the voltage for a proof, in multiples of its resolution."""
OCV_CHANGE_V = 0.01
"""Change of the OCV of one cell that proves a constant voltage frozen [V]."""
LOAD_C = 0.1
"""Minimum discharge current for the proof by the OCV, as a C-rate. Below it, only sudden changes count, because
chargers regulate the voltage."""
UNOBSERVED_CHARGE_ERROR = 0.1
"""Relative error of the charge counted while the voltage is not used."""
OUTLIERS_S = 3600.0
"""Time constant with which rejected single samples and single contradictions are discounted, and maximum averaging time of
the noise [s]."""


@njit(cache=True)
def detect_frozen_input(c: Record, f: Record, p: Record, dt_s: float, current_a: float, voltage_v: float) -> bool:
    """Update the durations of implausibly constant voltage and current; return True if the voltage is usable.

    The function must run before ``track_current_sign``, which updates the slow means.
    """
    counted_s = min(dt_s, FAST_S)
    has_fast_changes = dt_s <= FAST_S and c.slow_v != 0.0  # 0: there are no slow means yet
    ocv_moved = voltage_stuck = False
    # the root is one step: with the default noise of half a step, sensor_v2 is step^2 / 4 + step^2 / 12 = step^2 / 3
    resolved_v = MIN_RESOLUTION_STEPS * max(c.step_v, math.sqrt(3.0 * p.sensor_v2))
    change_v = abs(voltage_v - c.last_v)
    if c.last_v == 0.0 or change_v > 0.0:
        if c.last_v != 0.0:
            c.step_v = change_v if c.step_v == 0.0 else min(c.step_v, change_v)
        c.frozen_v_s = c.held_as = 0.0
        c.held_a, c.held_soc, c.held_soc_std = current_a, f.soc, f.soc_std
    else:
        c.held_as += 0.5 * (c.last_a + current_a) * min(dt_s, p.unmeasured_s)
        loaded = current_a >= LOAD_C * p.capacity_as / 3600.0
        ocv_moved = loaded and ocv_has_moved(c, f, p, current_a, resolved_v)
        # below LOAD_C the change must also be sudden
        change_a = abs(current_a - c.held_a) if loaded else min(abs(current_a - c.held_a), abs(current_a - c.slow_a))
        dropped_v = reference_series_resistance(p) * change_a if has_fast_changes else 0.0
        voltage_stuck = ocv_moved or dropped_v > max(VISIBLE_V * p.series, resolved_v)
        if voltage_stuck:
            c.frozen_v_s += counted_s
    c.same_s += dt_s
    if c.last_v == 0.0 or current_a != c.last_a:
        c.frozen_a_s = c.same_s = 0.0
        c.same_soc, c.same_soc_std = f.soc, f.soc_std
    # a charge that contradicts the voltage may also be due to a current that froze under load
    elif ocv_moved or (has_fast_changes and voltage_has_swung(c, p, counted_s, voltage_v, resolved_v)):
        c.frozen_a_s += counted_s
        is_dither = c.jump_v < 2.0 * SWING_V * p.series and c.jump_v2 < (1.0 + DITHER_SPREAD**2) * c.jump_v**2
        if is_dither and not ocv_moved and c.frozen_a_s - counted_s <= FROZEN_S:
            c.frozen_a_s = min(c.frozen_a_s, 0.5 * FROZEN_S)
    elif c.frozen_a_s < FROZEN_S:  # discount single glitches at rest
        c.frozen_a_s -= c.frozen_a_s * min(1.0, counted_s / OUTLIERS_S)
    c.last_v, c.last_a = voltage_v, current_a
    # after FROZEN_S the voltage passes again, because the next update of the filter reports the fault
    return not voltage_stuck or c.frozen_v_s <= SUSPECT_S or c.frozen_v_s > FROZEN_S


@njit(cache=True)
def voltage_has_swung(c: Record, p: Record, counted_s: float, voltage_v: float, resolved_v: float) -> bool:
    """Return True if a voltage change under a constant current exceeds the noise, and update the mean change."""
    share = counted_s / min(max(c.same_s, counted_s), OUTLIERS_S)  # a mean over the time of the constant current
    change_v = abs(voltage_v - c.last_v)
    c.noise_v += share * (change_v - c.noise_v)
    # a jump; the voltage has relaxed after the last step of the current
    if change_v > 0.5 * SWING_V * p.series and c.same_s > FROZEN_S:
        share = 1.0 if c.jump_v == 0.0 else JUMP_SHARE
        c.jump_v, c.jump_v2 = c.jump_v + share * (change_v - c.jump_v), c.jump_v2 + share * (change_v**2 - c.jump_v2)
    limit_v = max(SWING_V * p.series, resolved_v, NOISE_STEPS * c.noise_v)
    # the second difference is 0 for a steady drift of the voltage
    return abs(voltage_v - 2.0 * c.slow_v + c.slower_v) > limit_v


@njit(cache=True)
def reference_series_resistance(p: Record) -> float:
    """Return R_0 of the cell file at SOC 0.5 and 25 C [ohm]."""
    middle = p.weak_ohm.shape[0] // 2  # the parts with weak and with strong temperature dependence add up
    return p.weak_ohm[middle, 0] + p.strong_ohm[middle, 0]


@njit(cache=True)
def ocv_has_moved(c: Record, f: Record, p: Record, current_a: float, resolved_v: float) -> bool:
    """Return True if the charge since the last voltage change moved the OCV by more than the overpotential has changed."""
    if f.count > 1:  # several hypotheses: the SOC is uncertain
        return False
    now_soc = c.held_soc - c.held_as / p.capacity_as
    moved_v = ocv(c.held_soc, p.ocv_v, p.ocv_slope_v) - ocv(now_soc, p.ocv_v, p.ocv_slope_v)
    dropped_v = p.middle_ohm * (current_a - c.held_a)
    limit_v = max(OCV_CHANGE_V * p.series, resolved_v, abs(dropped_v))
    return min(abs(moved_v), abs(moved_v + dropped_v)) > limit_v


@njit(cache=True)
def rewind_to_freeze(c: Record, f: Record, p: Record) -> None:
    """Restore the SOC before a sensor froze. If only the voltage froze, count the charge since then."""
    if c.frozen_a_s > FROZEN_S:
        f.soc, f.soc_std = c.same_soc, c.same_soc_std + p.load_mean_c * c.same_s / 3600.0
    else:
        used_soc = c.held_as / p.capacity_as
        f.soc = min(max(c.held_soc - used_soc, 0.0), 1.0)
        f.soc_std = c.held_soc_std + UNOBSERVED_CHARGE_ERROR * abs(used_soc)
