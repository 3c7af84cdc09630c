"""Scaling of the board's sums to volts, amperes and degrees Celsius (firmware/PROTOCOL.md).

``s`` is the scaling of a board, a record of ``SCALING``.
"""

import math

import numpy as np

from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.messages import MODULUS

SCALING = np.dtype(
    [
        ("known", "i8"),  # 1 once a hello was received
        ("full_scale", "f8"),  # number of steps of the converter: 2^bits
        ("divider", "f8"),  # pack voltage over voltage at the pin
        ("volts_per_ampere", "f8"),  # slope of the current sensor [V/A]
        ("ratiometric", "i8"),  # 1: volts_per_ampere holds at 5 V, and is proportional to the reference
        ("current_zero", "f8"),  # output of the current sensor without current, as a fraction of the reference
        ("bandgap_v", "f8"),  # the converter's internal reference [V]
        ("ntc_series_ohm", "f8"),  # resistor in series with the NTC [ohm]
        ("ntc_r25_ohm", "f8"),  # resistance of the NTC at 25 degC [ohm]
        ("ntc_beta_k", "f8"),  # beta of the NTC [K]
        ("ntc_fitted", "i8"),  # 1: the board has an NTC
        ("bandgap_mean", "f8"),  # filtered mean of the bandgap readings, in steps of the converter
        ("bandgap_weight", "f8"),  # number of bandgap readings since the reset
        ("bandgap_us", "i8"),  # board_us of the last bandgap reading
        ("ntc_mean", "f8"),  # filtered mean of the NTC readings, in steps of the converter
        ("ntc_weight", "f8"),  # number of NTC readings since the reset
        ("ntc_us", "i8"),  # board_us of the last NTC reading
    ],
    align=True,
)

_BANDGAP_US = 5_120_000
"""Time constant of the bandgap's mean [us]; twice as long if NTC and bandgap are read alternately.

At 100 readings per second it covers 512 readings, so that 0.5 LSB of noise becomes 0.02 LSB in the mean.
"""
_NTC_US = 640_000
"""Time constant of the NTC's mean [us]. At 100 readings per second it covers 64 readings."""
_CLOCK_MASK = MODULUS - 1
_RAIL = 0.01  # an NTC within this fraction of either end of the range is open or shorted
_RATIOMETRIC_V = 5.0  # supply at which the data sheet of a ratiometric sensor gives its slope
_ZERO_C_K = 273.15
_R25_K = 298.15


@njit(cache=True)
def running_mean(mean: float, weight: float, total: float, count: float, elapsed_fraction: float) -> float:
    """Return the mean of ``weight`` earlier readings and ``count`` new readings with the sum ``total``.

    The mean is arithmetic at first, and exponential later.

    Args:
        mean: Mean of the earlier readings.
        weight: Number of earlier readings.
        total: Sum of the new readings.
        count: Number of new readings.
        elapsed_fraction: Time since the last readings divided by the time constant.
    """
    weight += count
    if elapsed_fraction * weight > count:  # the earlier readings span more than the time constant
        weight = max(count / elapsed_fraction, count)
    return mean + (total - mean * count) / weight


@njit(cache=True)
def add_bandgap(s: Record, total: float, count: float, board_us: int) -> None:
    """Update the filtered mean of the bandgap."""
    elapsed_fraction = ((board_us - s.bandgap_us) & _CLOCK_MASK) / (_BANDGAP_US * (1 + s.ntc_fitted))
    s.bandgap_mean = running_mean(s.bandgap_mean, s.bandgap_weight, total, count, elapsed_fraction)
    s.bandgap_weight += count
    s.bandgap_us = board_us


@njit(cache=True)
def add_ntc(s: Record, total: float, count: float, board_us: int) -> None:
    """Update the filtered mean of the NTC.

    A reading of an open or shorted NTC resets the mean, because a mean of valid and invalid readings would be plausible.
    """
    if not _RAIL < total / count / s.full_scale < 1.0 - _RAIL:
        s.ntc_mean = s.ntc_weight = 0.0
        return
    elapsed_fraction = ((board_us - s.ntc_us) & _CLOCK_MASK) / _NTC_US
    s.ntc_mean = running_mean(s.ntc_mean, s.ntc_weight, total, count, elapsed_fraction)
    s.ntc_weight += count
    s.ntc_us = board_us


@njit(cache=True)
def reset_readings(s: Record) -> None:
    """Reset reference and temperature after a reset or another board."""
    s.bandgap_mean = s.bandgap_weight = s.ntc_mean = s.ntc_weight = 0.0


@njit(cache=True)
def reference(s: Record) -> float:
    """Return the converter's full range [V]; NaN before the bandgap was measured."""
    if s.bandgap_mean <= 0.0:
        return math.nan
    return s.bandgap_v * s.full_scale / s.bandgap_mean


@njit(cache=True, error_model="numpy")  # a board that scales by zero gives inf or NaN, which the estimator drops
def temperature(s: Record) -> float:
    """Return the temperature of the NTC [C]; NaN without one or if it is open or shorted."""
    ratio = s.ntc_mean / s.full_scale  # voltage over the NTC as a fraction of the converter's range
    if not s.ntc_fitted or s.ntc_weight == 0.0 or not _RAIL < ratio < 1.0 - _RAIL:
        return math.nan
    r_ohm = s.ntc_series_ohm * ratio / (1.0 - ratio)
    return 1.0 / (1.0 / _R25_K + math.log(r_ohm / s.ntc_r25_ohm) / s.ntc_beta_k) - _ZERO_C_K


@njit(cache=True)
def voltage(s: Record, total: float, count: float, reference_v: float) -> float:
    """Return the voltage at the pack's terminals [V]; NaN without a conversion."""
    if count == 0.0:
        return math.nan
    return total / count / s.full_scale * reference_v * s.divider


@njit(cache=True, error_model="numpy")  # a board that scales by zero gives inf or NaN, which the estimator drops
def current(s: Record, total: float, count: float, reference_v: float) -> float:
    """Return the current through the sensor with the board's sign [A]; NaN without a conversion."""
    if count == 0.0:
        return math.nan
    range_v = _RATIOMETRIC_V if s.ratiometric else reference_v
    return (total / count / s.full_scale - s.current_zero) * range_v / s.volts_per_ampere
