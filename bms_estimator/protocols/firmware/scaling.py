"""Scaling of the board's sums to volts, amperes and degrees Celsius (firmware/PROTOCOL.md)."""

import math

import numpy as np

from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit
from bms_estimator.protocols.firmware.messages import MODULUS

SCALING = np.dtype(
    [
        ("known", "i8"),  # 1 once a hello was received
        ("full_scale", "f8"),  # conversions at the reference: 2^bits
        ("divider", "f8"),  # pack voltage over voltage at the pin
        ("volts_per_ampere", "f8"),  # slope of the current sensor [V/A]
        ("ratiometric", "i8"),  # 1: that slope holds at 5 V, and is proportional to the reference
        ("current_zero", "f8"),  # its output without current, as a fraction of the reference
        ("bandgap_v", "f8"),  # the converter's internal reference [V]
        ("ntc_series_ohm", "f8"),
        ("ntc_r25_ohm", "f8"),
        ("ntc_beta_k", "f8"),
        ("ntc_fitted", "i8"),
        ("bandgap_mean", "f8"),  # filtered conversions of the bandgap
        ("bandgap_weight", "f8"),  # conversions since the reset
        ("bandgap_us", "i8"),  # board_us of the last
        ("ntc_mean", "f8"),  # filtered conversions of the NTC
        ("ntc_weight", "f8"),
        ("ntc_us", "i8"),
    ],
    align=True,
)

# At the firmware's own rate these are 512 and 32 readings: 0.5 LSB of noise becomes 0.02 LSB in the bandgap's mean.
_BANDGAP_US = 5_120_000  # time constant; twice that if NTC and bandgap are read alternately
_NTC_US = 640_000
_CLOCK_MASK = MODULUS - 1
_RAIL = 0.01  # an NTC within this fraction of either end of the range is open or shorted
_RATIOMETRIC_V = 5.0  # supply at which the data sheet of a ratiometric sensor gives its slope
_ZERO_C_K = 273.15
_R25_K = 298.15


@njit(cache=True)
def running_mean(mean: float, weight: float, total: float, count: float, part: float) -> float:
    """Return the mean after adding ``count`` readings of sum ``total`` to the ``weight`` readings before.

    It is an arithmetic mean at first, and an exponential one later. ``part`` is the time since the last readings divided
    by the time constant.
    """
    weight += count
    if part * weight > count:
        weight = max(count / part, count)
    return mean + (total - mean * count) / weight


@njit(cache=True)
def take_bandgap(s: Record, total: float, count: float, board_us: int) -> None:
    """Update the filtered mean of the bandgap."""
    part = ((board_us - s.bandgap_us) & _CLOCK_MASK) / (_BANDGAP_US * (1 + s.ntc_fitted))
    s.bandgap_mean = running_mean(s.bandgap_mean, s.bandgap_weight, total, count, part)
    s.bandgap_weight += count
    s.bandgap_us = board_us


@njit(cache=True)
def take_ntc(s: Record, total: float, count: float, board_us: int) -> None:
    """Update the filtered mean of the NTC."""
    part = ((board_us - s.ntc_us) & _CLOCK_MASK) / _NTC_US
    s.ntc_mean = running_mean(s.ntc_mean, s.ntc_weight, total, count, part)
    s.ntc_weight += count
    s.ntc_us = board_us


@njit(cache=True)
def forget_readings(s: Record) -> None:
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
    x = s.ntc_mean / s.full_scale
    if not s.ntc_fitted or s.ntc_weight == 0.0 or not _RAIL < x < 1.0 - _RAIL:
        return math.nan
    r_ohm = s.ntc_series_ohm * x / (1.0 - x)
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
