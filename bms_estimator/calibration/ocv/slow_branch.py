"""Recognition of low-rate discharges and charges in captures, and the capacity from a complete discharge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from bms_estimator.calibration.cleaning.capture_checks import StartOrigin, StartSoc
from bms_estimator.calibration.cleaning.clean_capture import (
    mean_temperature_c,
    resting_samples,
    true_runs,
    with_matched_voltages,
)
from bms_estimator.model.arrays import Floats, Masks, SampleBlock
from bms_estimator.model.charge_count import are_long_gaps, charge_ah
from bms_estimator.model.errors import UserError

MIN_DURATION_S = 7.0 * 3600.0
"""Minimum duration of a low-rate curve [s]. A full curve at C/7 takes this long. Faster curves deviate too much from the OCV:
half of the difference between discharge and charge is already some 20 mV at C/10."""
MAX_CURRENT_DEVIATION = 0.05
"""A current is constant while its deviation from the median is at most this fraction of the median plus one standard
deviation of its noise."""
SMOOTH_SAMPLES = 31
"""Length of the median filter [samples]. It removes faults and divides the noise by about five."""
STD_PER_MEDIAN_STEP = 1.05
"""Standard deviation of white noise over the median absolute difference between its samples."""
EMPTY_FALL = 0.01
"""A discharge ends empty if the voltage falls by more than this fraction of its median while the last 1 % of the charge is
drawn."""
MAX_BEFORE_FRACTION = 0.01
"""Maximum net charge before a discharge that measures the capacity, as a fraction of its charge. Charging a full cell is
allowed."""


@dataclass(frozen=True)
class SlowBranch:
    """One low-rate discharge or charge.

    Attributes:
        name: Name of the capture.
        charge: True for a charge, False for a discharge.
        ah: Shape (n,), charge moved since the start of the curve, increasing [Ah].
        voltage_v: Shape (n,), terminal voltage [V].
        current_a: Mean magnitude of the current [A].
        temperature_c: Mean temperature [C]; NaN without a sensor.
        before_ah: Net charge drawn between the sample whose SOC is ``start`` and the start of the curve [Ah].
        start_v: Voltage of the rest before the curve [V]; NaN without a rest.
        step_v: Voltage jump at the fuller end of the curve [V]: at the start of a discharge, or at the end of a charge. NaN
            without a rest there.
        to_empty: True for a discharge down to empty.
        start: SOC at the first sample of the capture. For a discharge that starts with a full cell, it is the SOC at the
            start of the curve, 1.
    """

    name: str
    charge: bool
    ah: Floats
    voltage_v: Floats
    current_a: float
    temperature_c: float
    before_ah: float
    start_v: float
    step_v: float
    to_empty: bool
    start: StartSoc

    def label(self, capacity_ah: float) -> str:
        """Return a description such as "C/20 discharge"."""
        return f"C/{capacity_ah / self.current_a:.0f} {'charge' if self.charge else 'discharge'}"


def slow_branches(good: SampleBlock, name: str, start: StartSoc) -> list[SlowBranch]:
    """Return the low-rate discharges and charges of a capture without glitches.

    Args:
        good: Samples without glitches, dtype ``SAMPLE``.
        name: Name for messages.
        start: SOC at the first sample.

    Raises:
        UserError: The voltage changes in the wrong direction for the current.
    """
    moved_ah = charge_ah(good["time_s"], good["current_a"])
    if good.size < 2 or np.ptp(moved_ah) == 0.0:
        return []
    good = with_matched_voltages(good)
    smooth = good.copy()
    smooth["current_a"] = median_filter(good["current_a"], SMOOTH_SAMPLES, mode="nearest")
    noise_a = STD_PER_MEDIAN_STEP * float(np.median(np.abs(np.diff(good["current_a"]))))
    resting = resting_samples(smooth, capacity_ah=float(np.ptp(moved_ah)))  # the capacity itself is unknown here
    is_after_gap = np.r_[False, are_long_gaps(good["time_s"])]  # the charge of a curve with such a gap is unknown
    branches = []
    for first, last in true_runs(~resting):
        current_a = smooth["current_a"][first:last]
        middle_a = float(np.median(current_a))
        is_steady = np.abs(current_a - middle_a) <= MAX_CURRENT_DEVIATION * abs(middle_a) + noise_a
        for first_steady, end_steady in true_runs(is_steady & ~is_after_gap[first:last]):
            if good["time_s"][first + end_steady - 1] - good["time_s"][first + first_steady] >= MIN_DURATION_S:
                branches.append(_branch(good, moved_ah, resting, first + first_steady, first + end_steady, name, start))
    return branches


def _branch(
    good: SampleBlock, moved_ah: Floats, resting: Masks, first: int, last: int, name: str, start: StartSoc
) -> SlowBranch:
    """Return the low-rate discharge or charge in the samples ``first`` to ``last`` - 1.

    Raises:
        UserError: The voltage changes in the wrong direction for the current.
    """
    part = good[first:last]
    charge = bool(np.median(part["current_a"]) < 0.0)
    ah = np.abs(moved_ah[first:last] - moved_ah[first])
    voltage_v = part["voltage_v"].astype(np.float64)
    if charge != (voltage_v[-1] > voltage_v[0]):
        raise UserError(
            f"{name}: current has the wrong sign: {'charge' if charge else 'discharge'} from {part['time_s'][0]:.0f} s on "
            f"while the voltage went from {voltage_v[0]:.3f} to {voltage_v[-1]:.3f} V; discharge must be positive "
            "(--current-sign)"
        )
    jump_v = float("nan")  # at the full end: the end of a charge, the start of a discharge
    if charge and last < good.size and resting[last]:
        jump_v = voltage_v[-1] - float(good["voltage_v"][last])
    elif not charge and first > 0 and resting[first - 1]:
        jump_v = float(good["voltage_v"][first - 1]) - voltage_v[0]
    start_v = float(good["voltage_v"][first - 1]) if first > 0 and resting[first - 1] else float("nan")
    before_ah = float(moved_ah[first])
    # after a net discharge, a voltage above full_v does not mean a full cell
    if not charge and np.fmax(start_v, voltage_v[0]) >= start.full_v and before_ah <= 0.0:
        start, before_ah = replace(start, soc=1.0, origin=StartOrigin.FULL), 0.0
    # over the last hundredth of the charge, see EMPTY_FALL
    last_fall_v = float(np.interp(0.99 * ah[-1], ah, voltage_v)) - voltage_v[-1]
    return SlowBranch(
        name=name,
        charge=charge,
        ah=ah,
        voltage_v=voltage_v,
        current_a=float(np.abs(part["current_a"]).mean()),
        temperature_c=mean_temperature_c(part),
        before_ah=before_ah,
        start_v=start_v,
        step_v=float(np.maximum(jump_v, 0.0)),  # NaN stays NaN
        to_empty=not charge and last_fall_v > EMPTY_FALL * float(np.median(voltage_v)),
        start=start,
    )


def measured_capacity_ah(branches: Sequence[SlowBranch]) -> float:
    """Return the capacity [Ah] from the low-rate discharge to empty that is nearest to 25 °C; NaN without such a discharge.

    Only discharges that start at a given SOC or with a full cell count. Others give a lower bound at most.
    """
    complete = [
        branch
        for branch in branches
        if branch.to_empty
        and branch.start.is_exact
        and branch.start.soc > 0.0
        # after a charge, the SOC is unknown unless the cell was full before and remains full
        and (abs(branch.before_ah) if branch.start.soc < 1.0 else branch.before_ah)
        < MAX_BEFORE_FRACTION * branch.ah[-1]
    ]
    if not complete:
        return float("nan")
    nearest = min(complete, key=lambda branch: abs(np.nan_to_num(branch.temperature_c, nan=25.0) - 25.0))
    return float(nearest.ah[-1]) / nearest.start.soc
