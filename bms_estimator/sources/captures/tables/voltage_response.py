"""Response of the voltage to the current: direction of positive current, and of each load of a current without a sign."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import CurrentSign, Floats, SampleBlock, SampleStatus
from bms_estimator.model.charge_count import step_charges_as

HELD = int(SampleStatus.VOLTAGE_HELD | SampleStatus.CURRENT_HELD)
"""Status of samples with values of another time."""
LOAD_FRACTION = 0.01
"""Minimum current of a load, as a fraction of the largest current."""
STEP_FRACTION = 0.1
"""Minimum change of the current that counts as a step, as a fraction of the current's range. In a stretch of constant current it
is a fraction of the current itself."""
MIN_STEPS = 2
"""Minimum number of steps for a decision. A single step may be a glitch."""
MIN_STEPS_OF_LOAD = 5
"""Minimum number of steps that determine the direction of a load. A load with fewer is one of constant current."""
AGREEING_FRACTION = 0.8
"""Fraction of the steps, or of the charge, for which the voltage must respond in the same direction."""
MIN_STRETCH_FRACTION = 0.5
"""Minimum fraction of the charge in stretches of constant current, for a decision from the voltage in them."""
MIN_CORRELATION = 0.7
"""Minimum correlation of voltage and charge for a decision, if there are too few steps."""
MIN_TREND_ROWS = 20
"""Minimum number of samples for a decision from a trend of the voltage."""
NOISE_RATIO = 4.0
"""Minimum change of the voltage in a trend, in std of its noise. Stretches end at extremes of the voltage, which include noise."""
MIN_OTHER_FRACTION = 0.1
"""Minimum fraction of the charge that, according to the voltage, flows in the other direction. This fraction shows that the file
lacks the sign of the current, and that a load consists of charge and discharge without a rest between them."""
MIN_REVERSAL = 0.03
"""Minimum change of the voltage against the direction of a load, in a stretch of constant current, relative to the voltage.
Recovery after a larger current, and warming of a cold cell, change it less."""
MIN_CHANGE = 1e-3
"""Minimum change of the voltage that shows the direction of a load, relative to the voltage."""
LARGE_STRETCH_FRACTION = 0.02
"""Minimum fraction of the charge of a stretch that is divided at the extremes of its voltage."""


class VoltageResponse(NamedTuple):
    """Direction of the current that the voltage shows.

    Attributes:
        sign: Direction of positive current; None if the voltage shows none, or if the current has no sign.
        row_factors: Factors of the samples, 1 on discharge and -1 on charge, for a current without a sign. None if the current
            has a sign, or if the direction of a load is not known.
        has_no_sign: True if the current has one sign, but the voltage shows both charge and discharge.
    """

    sign: CurrentSign | None = None
    row_factors: Floats | None = None
    has_no_sign: bool = False


class _Parts(NamedTuple):
    """Parts of a capture, shape (n,) each: first and last sample, charge in the current's unit times s, change of the voltage."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    charge: Floats
    change_v: Floats


def voltage_response(samples: SampleBlock) -> VoltageResponse:
    """Return the direction of the current that a battery's voltage shows.

    The voltage falls during a discharge, and in a step of the current to a larger discharge. Held values are not used, because
    they are of another time.

    Args:
        samples: Samples with the current as in the table.
    """
    valid = np.isfinite(samples["current_a"]) & np.isfinite(samples["voltage_v"]) & np.isfinite(samples["time_s"])
    valid &= (samples["status"] & HELD) == 0
    rows = samples[valid]
    if rows.size < MIN_STEPS + 1 or not rows["current_a"].any():
        return VoltageResponse()
    with np.errstate(all="ignore"):  # values near the largest float overflow
        stretches = _constant_stretches(rows)
        has_one_sign = (rows["current_a"] >= 0.0).all() or (rows["current_a"] <= 0.0).all()
        if has_one_sign and (unsigned := _without_sign(rows, stretches)):
            if unsigned.row_factors is None:
                return unsigned
            row_index = np.maximum(np.cumsum(valid) - 1, 0)  # a sample that is not used belongs to the load before it
            return unsigned._replace(row_factors=unsigned.row_factors[row_index])
        response = (
            _trend_response(rows, stretches)
            or _step_response(rows["current_a"], rows["voltage_v"])
            or _charge_response(rows)
        )
    return VoltageResponse(None if response == 0 else "charge_positive" if response > 0 else "discharge_positive")


def _charge_steps(rows: SampleBlock) -> Floats:
    """Return the charge from each sample to the next one; the last one has none."""
    return np.append(step_charges_as(rows["time_s"], rows["current_a"]), 0.0)


def _parts(rows: SampleBlock, begins: NDArray[np.bool_], kept: NDArray[np.bool_]) -> _Parts:
    """Return the parts that begin where ``begins`` is set and whose samples are ``kept``."""
    first = np.flatnonzero(begins | np.r_[True, kept[1:] != kept[:-1]])
    last = np.append(first[1:], rows.size) - 1
    charge = np.add.reduceat(np.abs(_charge_steps(rows)), first)
    selected = kept[first]
    first, last, charge = first[selected], last[selected], charge[selected]
    return _Parts(first, last, charge, rows["voltage_v"][last] - rows["voltage_v"][first])


def _is_load(rows: SampleBlock) -> NDArray[np.bool_]:
    magnitude_a = np.abs(rows["current_a"])
    return np.asarray(magnitude_a > LOAD_FRACTION * magnitude_a.max())


def _constant_stretches(rows: SampleBlock) -> _Parts:
    """Return the stretches of constant current. A stretch with much charge is divided at the extremes of its voltage."""
    magnitude_a = np.abs(rows["current_a"])
    begins = np.abs(np.diff(rows["current_a"], prepend=rows["current_a"][:1])) > 0.5 * STEP_FRACTION * magnitude_a
    loaded = _is_load(rows)
    parts = _parts(rows, begins, loaded)
    for index in np.flatnonzero(parts.charge > LARGE_STRETCH_FRACTION * parts.charge.sum()):
        voltage_v = rows["voltage_v"][parts.first[index] : parts.last[index] + 1]
        for extreme in (int(np.argmin(voltage_v)), int(np.argmax(voltage_v))):
            begins[parts.first[index] + extreme] = True
    parts = _parts(rows, begins, loaded)
    drift_a = np.abs(magnitude_a[parts.last] - magnitude_a[parts.first])
    is_constant = drift_a <= STEP_FRACTION * magnitude_a[parts.first]
    return _Parts(*(column[is_constant] for column in parts))


def _without_sign(rows: SampleBlock, stretches: _Parts) -> VoltageResponse | None:
    """Return the directions of the loads of a current with one sign; None if all have the same direction."""
    loads = _parts(rows, np.zeros(rows.size, dtype=np.bool_), _is_load(rows))
    direction = _directions_from_steps(rows, loads)
    direction_from_ends, has_reversal = _directions_from_ends(rows, loads, stretches)
    has_reversal &= direction == 0.0
    direction = np.where(direction == 0.0, direction_from_ends, direction)
    total = loads.charge.sum()
    discharge, charge, reversing = (
        loads.charge[mask].sum() for mask in (direction > 0.0, direction < 0.0, has_reversal)
    )
    if reversing <= MIN_OTHER_FRACTION * total and min(discharge, charge) <= MIN_OTHER_FRACTION * total:
        return None
    if discharge + charge < (1.0 - MIN_OTHER_FRACTION) * total:
        return VoltageResponse(has_no_sign=True)
    factors = np.ones(rows.size)
    for first, last, factor in zip(loads.first, loads.last, direction, strict=True):
        factors[first : last + 1] = factor or 1.0
    return VoltageResponse(row_factors=factors, has_no_sign=True)


def _directions_from_steps(rows: SampleBlock, loads: _Parts) -> Floats:
    """Return 1 for loads in whose steps the voltage falls with the magnitude of the current, -1 if it rises, 0 for few steps."""
    index, rising = _steps(np.abs(rows["current_a"]), rows["voltage_v"])
    load = np.searchsorted(loads.first, index + 1, side="right") - 1  # a step from a rest belongs to the load after it
    index, rising, load = index[load >= 0], rising[load >= 0], load[load >= 0]
    count = np.bincount(load, minlength=loads.first.size)
    fraction = np.bincount(load, rising, loads.first.size) / np.maximum(count, 1)
    is_clear = (count >= MIN_STEPS_OF_LOAD) & (np.maximum(fraction, 1.0 - fraction) >= AGREEING_FRACTION)
    return np.where(is_clear, np.where(fraction > 0.5, -1.0, 1.0), 0.0)


def _directions_from_ends(rows: SampleBlock, loads: _Parts, stretches: _Parts) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the directions of loads, from their last voltage compared with the rests around them and with their first voltage.

    Returns:
        1 on discharge, -1 on charge, 0 if it is not clear; and whether a load consists of charge and discharge without a rest.
    """
    voltage_v = rows["voltage_v"]
    middle_v = float(np.median(np.abs(voltage_v)))
    before_v = np.where(loads.first > 0, voltage_v[loads.first - 1], voltage_v[loads.first])
    after_v = np.where(loads.last + 1 < rows.size, voltage_v[(loads.last + 1) % rows.size], voltage_v[loads.last])
    changes_v = np.array([voltage_v[loads.last] - before_v, voltage_v[loads.last] - after_v, loads.change_v])
    total_v = changes_v.sum(axis=0)
    is_clear = np.abs(total_v) >= np.maximum(0.5 * np.abs(changes_v).sum(axis=0), MIN_CHANGE * middle_v)
    direction = np.where(is_clear, -np.sign(total_v), 0.0)
    load = np.searchsorted(loads.first, stretches.first, side="right") - 1
    is_opposite = (np.sign(stretches.change_v) == direction[load]) & (
        np.abs(stretches.change_v) > MIN_REVERSAL * middle_v
    )
    opposite = np.bincount(load, stretches.charge * is_opposite, loads.first.size)
    has_reversal = opposite > MIN_OTHER_FRACTION * loads.charge
    return np.where(has_reversal, 0.0, direction), has_reversal


def _trend_response(rows: SampleBlock, stretches: _Parts) -> int:
    """Return 1 if the voltage rises while a positive current flows, -1 if it falls, weighted by charge; 0 if it is not clear."""
    charge = np.where(np.abs(stretches.change_v) > NOISE_RATIO * _noise(rows["voltage_v"]), stretches.charge, 0.0)
    samples = int((stretches.last - stretches.first + 1).sum())
    if samples < MIN_TREND_ROWS or charge.sum() < MIN_STRETCH_FRACTION * np.abs(_charge_steps(rows)).sum():
        return 0
    rising = float(np.sum(charge * (np.sign(rows["current_a"][stretches.first]) == np.sign(stretches.change_v))))
    fraction = rising / float(charge.sum()) if charge.any() else 0.5
    return 1 if fraction >= AGREEING_FRACTION else -1 if fraction <= 1.0 - AGREEING_FRACTION else 0


def _noise(voltage_v: Floats) -> float:
    """Return the std of white noise in the voltage, from the products of successive changes; 0 if most have the same direction."""
    changes_v = np.diff(voltage_v)
    return float(np.sqrt(max(-np.mean(changes_v[1:] * changes_v[:-1]), 0.0)))


def _steps(current_a: Floats, voltage_v: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the indices of the samples before steps of the current, and whether the voltage changes in the same direction."""
    current_step_a, voltage_step_v = np.diff(current_a), np.diff(voltage_v)
    range_a = float(np.ptp(current_a))
    is_step = (np.abs(current_step_a) >= STEP_FRACTION * range_a) & (voltage_step_v != 0.0) & (current_step_a != 0.0)
    return np.flatnonzero(is_step), np.sign(current_step_a[is_step]) == np.sign(voltage_step_v[is_step])


def _step_response(current_a: Floats, voltage_v: Floats) -> int:
    """Return 1 if the voltage rises in steps of the current upward, -1 if it falls, 0 if there are too few steps."""
    _, rising = _steps(current_a, voltage_v)
    if rising.size < MIN_STEPS:
        return 0
    fraction = float(np.mean(rising))
    return 1 if fraction >= AGREEING_FRACTION else -1 if fraction <= 1.0 - AGREEING_FRACTION else 0


def _charge_response(rows: SampleBlock) -> int:
    """Return 1 if the voltage rises with the integral of the current, -1 if it falls, 0 if neither is clear."""
    charge_as = np.cumsum(_charge_steps(rows)[:-1])
    voltage_v = rows["voltage_v"][1:]
    if rows.size < MIN_TREND_ROWS or not np.ptp(charge_as) > 0.0 or not np.ptp(voltage_v) > 0.0:
        return 0
    correlation = float(np.corrcoef(charge_as, voltage_v)[0, 1])
    return int(np.sign(correlation)) if abs(correlation) >= MIN_CORRELATION else 0  # 0 also if it is NaN
