"""Capacity from anchors: SOC from the open-circuit voltage of rests, and the charge counted between them.

    z_k = z_c - Ah_k / Q + (offset / Q) t_k

z_k is the SOC of anchor k, Ah_k the charge counted until its time t_k, Q the capacity, and z_c the SOC at the beginning
of the continuous part c of a capture. The equation is linear in 1/Q, offset/Q and each part's z_c. All anchors are
solved jointly by generalized least squares. The covariance contains the errors of SOC and charge, as in Plett (2011). The
offset of the current is an unknown with a prior. Errors of the OCV curve are correlated between anchors at similar SOCs,
so that repeated rests at one SOC do not reduce them.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.capacity_anchors import Anchor, find_anchors
from bms_estimator.estimator.filter_settings import CURVE_SOC, filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.settings.observer import IdentifierSettings

MIN_SOC_SPAN = 0.15
"""Minimum SOC difference between the lowest and the highest anchor."""
MAX_RELATIVE_CAPACITY_STD = 0.2
"""Maximum relative std of a capacity."""
MAX_DISTANCE_TO_CURVE_STDS = 3.0
"""Maximum distance of a rest's voltage from the voltage range of the OCV curve, in standard deviations. A larger distance
indicates another cell."""
MAX_REDUCED_CHI_SQUARED = 9.0
"""Maximum weighted squared residual of the anchors per degree of freedom: residuals of three times their expected errors."""
VOLTAGE_STEP_V = 1e-3
"""Assumed resolution of a capture's voltage [V]."""
MAX_SHOWN_REASONS = 8
"""Maximum number of rejected rests in a message."""
MIN_OFFSET_STD_A = 1e-9
"""Minimum std of the current's offset [A], so that its prior is finite."""


@dataclass(frozen=True)
class Capacity:
    """Result of a capacity measurement.

    Attributes:
        capacity_ah: Capacity [Ah].
        std_ah: Standard deviation of the capacity [Ah].
        offset_a: Offset of the current sensor [A]; near 0 if the anchors do not determine it.
        offset_std_a: Standard deviation of the offset [A].
        anchors: Anchors that were used.
        residual: Residual of each anchor: SOC from its voltage minus SOC from the charge.
        rejected: Reasons why other rests were rejected, one line each.
    """

    capacity_ah: float
    std_ah: float
    offset_a: float
    offset_std_a: float
    anchors: tuple[Anchor, ...]
    residual: tuple[float, ...]
    rejected: tuple[str, ...]


def measure_capacity(captures: Sequence[Columns], cell: CellModel, *, offset_std_a: float | None = None) -> Capacity:
    """Measure the capacity from the anchors of one or more captures of a cell.

    Args:
        captures: Captures of one cell, recorded within weeks, so that its capacity is constant.
        cell: Open-circuit voltage with its error. The cell's capacity only scales the limit of a rest's current.
        offset_std_a: Standard deviation of the offset of the current sensor [A]; None: the identifier's default.

    Raises:
        UserError: No two anchors are far enough apart (the message lists a reason for each rest), two captures are
            equal, or the captures contradict the curve or the sign of the current.
    """
    _check_distinct(captures)
    identifier = IdentifierSettings(current_offset_std_a=offset_std_a)
    settings = filter_settings(cell, ocv_grid(cell), identifier, VOLTAGE_STEP_V, None)[0]
    search = find_anchors(captures, settings)
    _check_range(search.anchors, settings)
    parts = [anchor.part for anchor in search.anchors]
    used = [anchor for anchor in search.anchors if parts.count(anchor.part) > 1]
    rejected = search.rejected + [
        f"{anchor.location}: no other anchor without a gap between"
        for anchor in search.anchors
        if parts.count(anchor.part) == 1
    ]
    _check_span(used, rejected, cell.cell.capacity_ah)
    return _solve(used, rejected, settings)


def _check_distinct(captures: Sequence[Columns]) -> None:
    """Check that no capture is given twice, because a duplicate would halve the variance of the result.

    Raises:
        UserError: Two captures have equal samples.
    """
    for one, other in itertools.combinations(captures, 2):
        if all(np.array_equal(one.rows[name], other.rows[name]) for name in ("time_s", "current_a", "voltage_v")):
            raise UserError(f"{one.name} and {other.name}: the same samples; give each capture once")


def _check_range(anchors: Sequence[Anchor], settings: np.void) -> None:
    """Check that most rests lie within the voltage range of the OCV curve.

    Raises:
        UserError: Most rests lie outside this range, so that the curve belongs to another cell.
    """
    low_v, high_v = float(settings["ocv_v"][0]), float(settings["ocv_v"][-1])
    outside = [
        anchor
        for anchor in anchors
        if max(low_v - anchor.rest.ocv_v, anchor.rest.ocv_v - high_v)
        > MAX_DISTANCE_TO_CURVE_STDS * np.hypot(anchor.voltage_std_v, anchor.curve_std_v)
    ]
    if 2 * len(outside) > len(anchors):
        volts = [anchor.rest.ocv_v for anchor in outside]
        raise UserError(
            f"no capacity: {len(outside)} of {len(anchors)} rests, at {min(volts):.3f}..{max(volts):.3f} V, are beyond the "
            f"curve of the cell, {low_v:.3f}..{high_v:.3f} V: check the cell file and its number of cells in series"
        )


def _check_span(anchors: Sequence[Anchor], rejected: Sequence[str], capacity_ah: float) -> None:
    """Check that the anchors of a part span enough SOC.

    Raises:
        UserError: There are no anchors, or their SOCs are too close.
    """
    reasons = "".join(f"\n  {line}" for line in rejected[:MAX_SHOWN_REASONS])
    if not anchors:
        raise UserError(
            "no capacity: no two rests give an SOC without a gap between them; rest the cell for half an hour "
            f"near full and again near empty, or give a whole slow discharge to `ocv`{':' if reasons else ''}{reasons}"
        )
    parts = [[anchor for anchor in anchors if anchor.part == part] for part in {anchor.part for anchor in anchors}]
    soc_span = max(np.ptp([anchor.soc for anchor in part]) for part in parts)
    counted_span = max(np.ptp([anchor.counted_ah for anchor in part]) for part in parts) / capacity_ah
    if soc_span < MIN_SOC_SPAN <= 0.5 * counted_span:  # enough charge: the voltages or the current must be wrong
        raise UserError(
            f"no capacity: the voltages of the rests are at most {soc_span:.2f} of SOC apart, the charge between them is "
            f"{counted_span:.2f} of the declared capacity: check the curve of the cell file, and that the current is in ampere"
        )
    if soc_span < MIN_SOC_SPAN:
        raise UserError(
            f"no capacity: the anchors of a capture are at most {soc_span:.2f} of SOC apart, at least {MIN_SOC_SPAN} are "
            f"needed: rest again after more charge{':' if reasons else ''}{reasons}"
        )


def _solve(anchors: Sequence[Anchor], rejected: Sequence[str], settings: np.void) -> Capacity:
    """Solve for 1/Q, offset/Q and each part's first SOC by generalized least squares.

    Raises:
        UserError: The anchors contradict each other or the sign of the current, or do not determine the capacity.
    """
    capacity_ah = float(settings["capacity_as"]) / 3600.0
    soc = np.array([anchor.soc for anchor in anchors])
    model_rows = _model_rows(anchors)
    precision = np.linalg.inv(_covariance(anchors, settings))
    prior = np.zeros((model_rows.shape[1], model_rows.shape[1]))
    # inverse variance of offset/Q, the second unknown
    prior[1, 1] = (capacity_ah / max(float(settings["offset_c"]) * capacity_ah, MIN_OFFSET_STD_A)) ** 2
    covariance = np.linalg.inv(model_rows.T @ precision @ model_rows + prior)
    unknowns = covariance @ model_rows.T @ precision @ soc
    residual = soc - model_rows @ unknowns
    degrees_of_freedom = len(anchors) - model_rows.shape[1] + 1  # the prior of the offset counts as a measurement
    reduced_chi_squared = float(residual @ precision @ residual) / degrees_of_freedom if degrees_of_freedom > 0 else 1.0
    covariance *= max(1.0, reduced_chi_squared)
    relative_std = float(np.sqrt(covariance[0, 0]) / abs(unknowns[0]))
    _check_solution(float(unknowns[0]), relative_std, reduced_chi_squared, len(anchors))
    solved_ah = 1.0 / float(unknowns[0])
    return Capacity(
        capacity_ah=solved_ah,
        std_ah=relative_std * solved_ah,
        offset_a=float(unknowns[1]) * solved_ah,
        offset_std_a=float(np.sqrt(covariance[1, 1])) * solved_ah,
        anchors=tuple(anchors),
        residual=tuple(map(float, residual)),
        rejected=tuple(rejected),
    )


def _model_rows(anchors: Sequence[Anchor]) -> Floats:
    """Return the factors of 1/Q, offset/Q and each part's first SOC, one row for each anchor."""
    parts = sorted({anchor.part for anchor in anchors})
    return np.array(
        [
            [-anchor.counted_ah, anchor.time_s / 3600.0, *(float(anchor.part == part) for part in parts)]
            for anchor in anchors
        ]
    )


def _covariance(anchors: Sequence[Anchor], settings: np.void) -> Floats:
    """Return the covariance of the anchors' SOCs that follows from the errors of voltage, curve and charge count."""
    soc, slope_v, voltage_std_v, curve_std_v, throughput_ah, part = (
        np.array([getattr(anchor, name) for anchor in anchors])
        for name in ("soc", "slope_v", "voltage_std_v", "curve_std_v", "throughput_ah", "part")
    )
    correlation = np.exp(-np.abs(soc[:, None] - soc) / CURVE_SOC)
    voltage_covariance = np.diag(voltage_std_v**2) + correlation * np.outer(curve_std_v, curve_std_v)
    capacity_ah = settings["capacity_as"] / 3600.0
    counting = settings["charge_error"] ** 2 * np.minimum.outer(throughput_ah, throughput_ah) / capacity_ah
    from_counting = np.where(part[:, None] == part, counting, 0.0)
    return np.asarray(voltage_covariance / np.outer(slope_v, slope_v) + from_counting)


def _check_solution(
    inverse_capacity: float, relative_std: float, reduced_chi_squared: float, anchor_count: int
) -> None:
    """Check 1/Q [1/Ah], its relative std, and the residual of the anchors.

    Raises:
        UserError: The anchors contradict each other or the sign of the current, or do not determine the capacity.
    """
    if inverse_capacity < 0.0 and relative_std < MAX_RELATIVE_CAPACITY_STD:
        raise UserError(
            "no capacity: the voltages of the rests rise where charge is counted out of the cell: "
            "check the sign of the current (--current-sign)"
        )
    if reduced_chi_squared > MAX_REDUCED_CHI_SQUARED:
        raise UserError(
            f"no capacity: voltages and charge of {anchor_count} anchors disagree by {np.sqrt(reduced_chi_squared):.1f} "
            f"times their expected errors: check the curve of the cell file, and that all captures are of one cell"
        )
    if inverse_capacity <= 0.0 or relative_std > MAX_RELATIVE_CAPACITY_STD:
        raise UserError(
            f"no capacity: {anchor_count} anchors determine it to {100.0 * relative_std:.0f} % only: give longer rests, further "
            "apart, or a cell file with a more exact curve"
        )
