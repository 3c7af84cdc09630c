"""Low-rate curves: open-circuit voltage from discharges and charges at a small constant current (pseudo-OCV).

The open-circuit voltage is the mean of a discharge and a charge of one cell. The hysteresis is half of their difference
less the ohmic drop. An unpaired discharge or charge gives the open-circuit voltage with an error of half the
difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter

from bms_estimator.calibration.cleaning.mismatched_steps import with_matched_voltages
from bms_estimator.calibration.cleaning.rests import SOC_SLACK, mean_temperature_c, resting_samples, true_runs
from bms_estimator.calibration.cleaning.start_soc import StartOrigin, StartSoc
from bms_estimator.calibration.ocv.points import COLD_V, Points, coldness
from bms_estimator.model.arrays import Floats
from bms_estimator.model.charge_count import are_long_gaps, charge_ah
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

MIN_DURATION_S = 7.0 * 3600.0
"""Minimum duration of a low-rate curve [s]. A full curve at C/7 takes this long. Faster curves deviate too much from the OCV:
half of the difference between discharge and charge is already some 20 mV at C/10."""
MAX_CURRENT_DEVIATION = 0.05
"""Maximum relative deviation of a constant current from its median, in addition to a standard deviation of its
noise."""
SMOOTH_SAMPLES = 31
"""Length of the median filter [samples]. It removes faults and divides the noise by about five."""
STD_PER_MEDIAN_STEP = 1.05
"""Standard deviation of white noise over the median absolute difference between its samples."""
EMPTY_FALL = 0.01
"""Minimum relative fall of the voltage over the last hundredth of the charge for a discharge that ends empty."""
MAX_BEFORE_FRACTION = 0.01
"""Maximum charge drawn before a full discharge, as a fraction of the discharge's charge."""
PAIR_K = 5.0
"""Maximum temperature difference between discharge and charge of a pair [K]."""
PAIR_CURRENT = 0.3
"""Maximum relative difference of the current between discharge and charge of a pair."""
MAX_MISSING_SOC = 0.1
"""Maximum SOC by which a charge may end below full. A larger difference means an incomplete charge or a wrong
current."""
GRID = np.unique(
    np.round(np.r_[np.arange(0, 0.1, 0.005), np.arange(0.1, 0.95, 0.01), np.arange(0.95, 1.0, 0.005), 1], 4)
)
"""SOC grid of the points of a low-rate curve."""
EVEN_SOC = np.linspace(0.0, 1.0, 201)
"""SOC grid of the smoothed hysteresis."""
HYSTERESIS_WIDTH = 0.01
"""Std in SOC of the Gaussian that smooths the hysteresis. Without smoothing, a knee at different SOCs in charge and
discharge would appear as hysteresis."""
HYSTERESIS_SOC = (0.03, 0.98)
"""SOC range of the measured hysteresis. Outside, the value at the end of the range is used, because the curves have
end-point transients there."""
POINT_V = 1e-3
"""Assumed std of the voltage of a point of a low-rate curve, per cell in series [V]."""
POINT_SOC = 0.002
"""Assumed std of the SOC of a point of a low-rate curve."""
PAIR_V = 1.5e-3
"""Assumed constant part of the systematic error of the mean of a pair, per cell in series [V]."""
PAIR_FRACTION = 0.1
"""Assumed variable part of the systematic error of the mean of a pair, as a fraction of the half difference between charge
and discharge."""
UNPAIRED_FRACTION = 0.5
"""Assumed systematic error as a fraction of the half difference, at SOCs where only one curve of a pair has data."""
END_TRANSIENT_SOC = 0.03
"""SOC range before the end of a charge that stops early. The voltage rises there before the end, so that the range is
not averaged with the discharge."""
UNPAIRED_V = 0.01
"""Assumed systematic error of an unpaired curve without its ohmic part, per cell in series [V]."""
UNPAIRED_OHMIC_FRACTION = 0.5
"""Ohmic part of the systematic error of an unpaired curve, as a fraction of the ohmic drop, which is measured only at the full
end and subtracted at every SOC."""
PAIR_COLD_FRACTION = 0.25
"""Fraction of the error ``COLD_V``, by which a cold cell relaxes too slowly, that remains in the mean of charge and discharge.
An unpaired curve has all of this error."""


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
        before_ah: Net charge drawn between the start of the capture and the start of the curve [Ah].
        start_v: Voltage of the rest before the curve [V]; NaN without a rest.
        step_v: Jump of the voltage when the current starts or stops at the end of the curve at which the cell is full [V]; NaN
            without a rest there.
        to_empty: True for a discharge down to empty.
        start: SOC at the first sample of the capture; full if the curve itself is a discharge that starts with a full cell.
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


@dataclass(frozen=True)
class SlowCurve:
    """Open-circuit voltage from a paired or unpaired low-rate curve.

    Attributes:
        branches: An unpaired discharge or charge, or a pair of both.
        points: Points on ``GRID``.
        hysteresis_v: Hysteresis at ``GRID`` [V]; None for an unpaired curve.
        notes: Remarks, one line each.
    """

    branches: tuple[SlowBranch, ...]
    points: Points
    hysteresis_v: Floats | None
    notes: tuple[str, ...]


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
    good: SampleBlock, moved_ah: Floats, resting: NDArray[np.bool_], first: int, last: int, name: str, start: StartSoc
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
    if not charge and np.fmax(start_v, voltage_v[0]) >= start.full_v and moved_ah[first] <= 0.0:
        start = replace(start, soc=1.0, origin=StartOrigin.FULL)
    # over the last hundredth of the charge, see EMPTY_FALL
    last_fall_v = float(np.interp(0.99 * ah[-1], ah, voltage_v)) - voltage_v[-1]
    return SlowBranch(
        name=name,
        charge=charge,
        ah=ah,
        voltage_v=voltage_v,
        current_a=float(np.abs(part["current_a"]).mean()),
        temperature_c=mean_temperature_c(part),
        before_ah=float(moved_ah[first]),
        start_v=start_v,
        step_v=float(np.maximum(jump_v, 0.0)),  # NaN stays NaN
        to_empty=not charge and last_fall_v > EMPTY_FALL * float(np.median(voltage_v)),
        start=start,
    )


def measured_capacity_ah(branches: Sequence[SlowBranch]) -> float:
    """Return the capacity by the low-rate discharge down to empty nearest to 25 C [Ah]; NaN without one.

    Only discharges count that start at a given SOC or with a full cell, because others give a lower bound at most.
    """
    known = [
        branch
        for branch in branches
        if branch.to_empty
        and branch.start.is_exact
        and branch.start.soc > 0.0
        and branch.before_ah < MAX_BEFORE_FRACTION * branch.ah[-1]
    ]
    if not known:
        return float("nan")
    nearest = min(known, key=lambda branch: abs(np.nan_to_num(branch.temperature_c, nan=25.0) - 25.0))
    return float(nearest.ah[-1]) / nearest.start.soc


def slow_curves(branches: Sequence[SlowBranch], capacity_ah: float, *, series_count: int = 1) -> list[SlowCurve]:
    """Return the curves of pairs of a discharge and a charge, and of the remaining unpaired branches.

    Args:
        branches: Branches of all captures.
        capacity_ah: Capacity that SOC is counted against [Ah].
        series_count: Cells in series, for values per cell.

    Raises:
        UserError: A discharge draws more than the capacity.
    """
    charges = [branch for branch in branches if branch.charge]
    curves = []
    for discharge in (branch for branch in branches if not branch.charge):
        # a charge before the discharge may have filled the cell
        start_soc = min(discharge.start.soc - discharge.before_ah / capacity_ah, 1.0)
        soc = start_soc - discharge.ah / capacity_ah
        if soc[-1] < -SOC_SLACK:
            raise UserError(
                f"{discharge.name}: SOC runs from {soc[0]:.3f} to {soc[-1]:.3f}, outside 0..1: {discharge.ah[-1]:.3f} Ah were "
                f"drawn, more than a capacity of {capacity_ah:g} Ah holds; give the right capacity or initial SOC"
            )
        charge = next((candidate for candidate in charges if _are_pair(discharge, candidate)), None)
        if charge is None:
            curves.append(_unpaired(discharge, soc, series_count, ()))
            continue
        charges.remove(charge)
        charge_soc = soc[-1] + charge.ah / capacity_ah
        if charge_soc[-1] < 1.0 - MAX_MISSING_SOC:
            incomplete = (
                f"its charge {charge.name} left out: {charge.ah[-1]:.3f} Ah went in after {discharge.ah[-1]:.3f} Ah had "
                "come out, so the charge is incomplete or its current is wrong"
            )
            curves.append(_unpaired(discharge, soc, series_count, (incomplete,)))
            continue
        if charge_soc[-1] > 1.0:  # more went in than the capacity: the charge ends full
            charge_soc = soc[-1] + (1.0 - soc[-1]) * charge.ah / charge.ah[-1]
        curves.append(_pair(discharge, soc, charge, charge_soc, series_count))
    return curves + [
        _unpaired(charge, 1.0 - (charge.ah[-1] - charge.ah) / capacity_ah, series_count, ("assumed to end full",))
        for charge in charges
    ]


def _are_pair(discharge: SlowBranch, charge: SlowBranch) -> bool:
    """Return True if temperatures and currents are nearly equal."""
    difference_k = charge.temperature_c - discharge.temperature_c
    near_temperature = np.isnan(difference_k) or abs(difference_k) <= PAIR_K
    return bool(near_temperature) and abs(charge.current_a / discharge.current_a - 1.0) <= PAIR_CURRENT


def _pair(
    discharge: SlowBranch, discharge_soc: Floats, charge: SlowBranch, charge_soc: Floats, series_count: int
) -> SlowCurve:
    """Return the mean of a discharge and a charge.

    At SOCs at which only one of them has data, that curve is shifted by half of the median difference.
    """
    low, high = max(discharge_soc[-1], charge_soc[0]), min(discharge_soc[0], charge_soc[-1])
    if high <= HYSTERESIS_SOC[1]:  # the voltage of a charge that stops early rises before its end
        high -= END_TRANSIENT_SOC
    grid_of_both = GRID[(low <= GRID) & (high >= GRID)]
    half_difference_v = 0.5 * (
        _voltage_at(grid_of_both, charge_soc, charge.voltage_v)
        - _voltage_at(grid_of_both, discharge_soc, discharge.voltage_v)
    )
    median_half_v = float(np.median(half_difference_v))
    half_v = np.where((low <= GRID) & (high >= GRID), np.interp(GRID, grid_of_both, half_difference_v), median_half_v)
    grid = GRID[(min(discharge_soc[-1], charge_soc[0]) <= GRID) & (max(discharge_soc[0], charge_soc[-1]) >= GRID)]
    half_on_grid_v = np.interp(grid, GRID, half_v)
    has_discharge = (grid >= discharge_soc[-1]) & (grid <= discharge_soc[0])
    ocv_v = np.where(
        has_discharge,
        _voltage_at(grid, discharge_soc, discharge.voltage_v) + half_on_grid_v,
        _voltage_at(grid, charge_soc, charge.voltage_v) - half_on_grid_v,
    )
    steps = [branch.step_v for branch in (discharge, charge) if np.isfinite(branch.step_v)]
    ohmic_v = float(np.mean(steps)) if steps else 0.0
    points = _points(grid, ocv_v, PAIR_V * series_count, PAIR_COLD_FRACTION, discharge.temperature_c, series_count)
    unpaired = (grid < low) | (grid > high)
    return SlowCurve(
        branches=(discharge, charge),
        points=replace(
            points,
            systematic_std_v=points.systematic_std_v
            + np.where(unpaired, UNPAIRED_FRACTION, PAIR_FRACTION) * np.abs(half_on_grid_v),
        ),
        hysteresis_v=_smooth(half_v - ohmic_v),
        notes=() if steps else ("hysteresis includes the ohmic drop",),
    )


def _unpaired(branch: SlowBranch, soc: Floats, series_count: int, notes: tuple[str, ...]) -> SlowCurve:
    """Return the curve of an unpaired discharge or charge, without its ohmic drop."""
    grid = GRID[(soc.min() <= GRID) & (soc.max() >= GRID)]
    sign = -1.0 if branch.charge else 1.0
    ohmic_v = float(np.nan_to_num(branch.step_v))
    ocv_v = _voltage_at(grid, soc, branch.voltage_v) + sign * ohmic_v
    systematic_std_v = UNPAIRED_V * series_count + UNPAIRED_OHMIC_FRACTION * ohmic_v
    points = replace(
        _points(grid, ocv_v, systematic_std_v, 1.0, branch.temperature_c, series_count),
        direction=np.full(grid.size, 1.0 if branch.charge else -1.0),
    )
    return SlowCurve((branch,), points, None, notes)


def _voltage_at(grid: Floats, soc: Floats, voltage_v: Floats) -> Floats:
    """Return the voltage of a branch at the SOCs ``grid`` [V]."""
    order = np.argsort(soc, kind="stable")
    return np.asarray(np.interp(grid, soc[order], voltage_v[order]))


def _points(
    grid: Floats, ocv_v: Floats, systematic_std_v: float, cold_fraction: float, temperature_c: float, series_count: int
) -> Points:
    """Return the points of a low-rate curve at the SOCs ``grid``.

    Args:
        grid: SOC of the points.
        ocv_v: Open-circuit voltage [V].
        systematic_std_v: Std of the systematic error [V].
        cold_fraction: Fraction of the error ``COLD_V`` of relaxation in the cold that remains.
        temperature_c: Temperature [C]; NaN if unknown.
        series_count: Cells in series.
    """
    std_v = np.hypot(POINT_V * series_count, POINT_SOC * np.gradient(ocv_v, grid))
    everywhere = np.ones(grid.size)
    cold_v = cold_fraction * COLD_V * series_count * coldness(temperature_c * everywhere)
    return Points(
        soc=grid,
        ocv_v=ocv_v,
        std_v=std_v,
        systematic_std_v=systematic_std_v * everywhere,
        cold_v=cold_v,
        temperature_c=temperature_c * everywhere,
    )


def _smooth(hysteresis_v: Floats) -> Floats:
    """Return a smooth hysteresis at ``GRID``, at least 0, constant outside ``HYSTERESIS_SOC``."""
    inside = np.clip(np.interp(np.clip(EVEN_SOC, *HYSTERESIS_SOC), GRID, hysteresis_v), 0.0, None)
    smooth = gaussian_filter1d(inside, HYSTERESIS_WIDTH / (EVEN_SOC[1] - EVEN_SOC[0]), mode="nearest")
    return np.asarray(np.interp(GRID, EVEN_SOC, smooth))
