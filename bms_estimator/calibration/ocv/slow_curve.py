"""Low-rate curves: open-circuit voltage from discharges and charges at a small constant current (pseudo-OCV).

The open-circuit voltage is the mean of a discharge and a charge of one cell. The hysteresis is half of their difference
less the ohmic drop. An unpaired discharge or charge gives the open-circuit voltage with an error of half the
difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from bms_estimator.calibration.cleaning.clean_capture import SOC_SLACK
from bms_estimator.calibration.ocv.chen_mora_fit import COLD_V, Points, relaxation_excess
from bms_estimator.calibration.ocv.slow_branch import SlowBranch
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError

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
"""Fraction of ``COLD_V``, the error due to slow relaxation in the cold, that remains in the mean of charge and discharge.
An unpaired curve has all of this error."""


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
            curves.append(_unpaired_curve(discharge, soc, series_count, ()))
            continue
        charges.remove(charge)
        charge_soc = soc[-1] + charge.ah / capacity_ah
        if charge_soc[-1] < 1.0 - MAX_MISSING_SOC:
            incomplete = (
                f"its charge {charge.name} left out: {charge.ah[-1]:.3f} Ah went in after {discharge.ah[-1]:.3f} Ah had "
                "come out, so the charge is incomplete or its current is wrong"
            )
            curves.append(_unpaired_curve(discharge, soc, series_count, (incomplete,)))
            continue
        if charge_soc[-1] > 1.0:  # more went in than the capacity: the charge ends full
            charge_soc = soc[-1] + (1.0 - soc[-1]) * charge.ah / charge.ah[-1]
        curves.append(_paired_curve(discharge, soc, charge, charge_soc, series_count))
    return curves + [
        _unpaired_curve(charge, 1.0 - (charge.ah[-1] - charge.ah) / capacity_ah, series_count, ("assumed to end full",))
        for charge in charges
    ]


def _are_pair(discharge: SlowBranch, charge: SlowBranch) -> bool:
    """Return True if temperatures and currents are nearly equal."""
    difference_k = charge.temperature_c - discharge.temperature_c
    near_temperature = np.isnan(difference_k) or abs(difference_k) <= PAIR_K
    return bool(near_temperature) and abs(charge.current_a / discharge.current_a - 1.0) <= PAIR_CURRENT


def _paired_curve(
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


def _unpaired_curve(branch: SlowBranch, soc: Floats, series_count: int, notes: tuple[str, ...]) -> SlowCurve:
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
    cold_v = cold_fraction * COLD_V * series_count * relaxation_excess(temperature_c * everywhere)
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
