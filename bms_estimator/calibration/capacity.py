"""Capacity from anchors: SOC by the open-circuit voltage of rests, and the charge counted between them.

    z_k = z_c - Ah_k / Q + (offset / Q) t_k

z_k is the SOC of anchor k, Ah_k the charge counted until its time t_k, Q the capacity, and z_c the SOC at the beginning
of the continuous part c of a capture. The equation is linear in 1/Q, offset/Q and each part's z_c. All anchors are
solved jointly by generalized least squares. Plett (2011) weighs the errors of both axes; here the offset of the current
is an unknown with a prior. Errors of the OCV curve are correlated between anchors at similar SOCs, so that they cancel
in a capacity between two anchors at the same SOC.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import MIN_GAP_CHARGE, MIN_GAP_PERIODS
from bms_estimator.calibration.cleaning.rests import remove_glitches, resting_samples, true_runs
from bms_estimator.calibration.ocv.points import COLD_V, LONG_REST_S, RELAXED_V, coldness
from bms_estimator.calibration.ocv.relaxation_test import Rest, find_rests
from bms_estimator.estimator.filter_settings import CURVE_SOC, filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv, soc_from_ocv
from bms_estimator.kernels.cell_model.open_loop import hysteresis
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_J, REFERENCE_C, arrhenius, on_grid
from bms_estimator.kernels.kalman_filter.hypotheses import HYST_STD
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings

MAX_ANCHOR_SOC_STD = 0.1
"""Maximum std of an anchor's SOC."""
MIN_SOC_SPAN = 0.15
"""Minimum SOC difference between the lowest and the highest anchor."""
MAX_RELATIVE_CAPACITY_STD = 0.2
"""Maximum relative std of a capacity."""
MAX_BEYOND_CURVE_STDS = 3.0
"""Maximum distance of a rest's voltage beyond the curve's ends, in standard deviations. A larger distance indicates
another cell."""
MAX_REDUCED_CHI_SQUARED = 9.0
"""Maximum weighted squared residual of the anchors per degree of freedom."""
VOLTAGE_STEP_V = 1e-3
"""Assumed resolution of a capture's voltage [V]."""
OFFSET_ITERATIONS = 3
"""Number of iterations that subtract hysteresis and entropy from a rest's voltage. Few suffice, because both hardly
change with SOC."""
SLOPE_SOC = 0.02
"""Half of the SOC interval over which the slope of the OCV at a rest is computed."""
HYSTERESIS_STD = 0.3
"""Std of the hysteresis state h (-1 after a discharge, 1 after a charge) with a known direction of the current. The std
covers the error of the amplitude, which has the opposite sign after a charge."""


@dataclass(frozen=True)
class Anchor:
    """A rest whose voltage gives the SOC.

    Attributes:
        capture: Name of the capture.
        part: Number of the continuous part, over all captures.
        time_s: Time of the rest's end, on the capture's clock [s].
        rest: The detected rest.
        soc: SOC by the rest's voltage.
        soc_std: Standard deviation of ``soc``, with the error of the curve.
        counted_ah: Net charge drawn since the part began [Ah].
        throughput_ah: Sum of charge and discharge since the part began [Ah].
        slope_v: Slope dOCV/dSOC at ``soc`` [V].
        own_std_v: Standard deviation of the voltage, independent of other anchors [V].
        curve_std_v: Standard deviation of the OCV curve at ``soc``, correlated between anchors [V].
    """

    capture: str
    part: int
    time_s: float
    rest: Rest
    soc: float
    soc_std: float
    counted_ah: float
    throughput_ah: float
    slope_v: float
    own_std_v: float
    curve_std_v: float


@dataclass(frozen=True)
class Capacity:
    """Result of a capacity measurement.

    Attributes:
        capacity_ah: Capacity [Ah].
        std_ah: Standard deviation of the capacity [Ah].
        offset_a: Offset of the current sensor [A]; near 0 if the anchors do not determine it.
        offset_std_a: Standard deviation of the offset [A].
        anchors: Anchors that were used.
        residual: Residual of each anchor: SOC by its voltage minus SOC by the charge.
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
    """Measure the capacity by the anchors of one or more captures of a cell.

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
    anchors: list[Anchor] = []
    rejected: list[str] = []
    parts = 0
    for capture in captures:
        good = remove_glitches(capture.rows, capture.name)
        for first, last in continuous_parts(good, cell.cell.capacity_ah):
            append_anchors(capture.name, parts, good[first:last], settings, anchors, rejected)
            parts += 1
    single_parts = {anchor.part for anchor in anchors if sum(other.part == anchor.part for other in anchors) == 1}
    rejected += [
        f"{_location(anchor)}: no other anchor without a gap between"
        for anchor in anchors
        if anchor.part in single_parts
    ]
    used = [anchor for anchor in anchors if anchor.part not in single_parts]
    _check_range(anchors, settings)
    _check_swing(used, rejected, cell.cell.capacity_ah)
    return _solve(used, rejected, settings)


def _check_distinct(captures: Sequence[Columns]) -> None:
    """Check that no capture is given twice, because a duplicate would halve the variance of the result.

    Raises:
        UserError: Two captures have equal samples.
    """
    for one, other in itertools.combinations(captures, 2):
        if all(np.array_equal(one.rows[name], other.rows[name]) for name in ("time_s", "current_a", "voltage_v")):
            raise UserError(f"{one.name} and {other.name}: the same samples; give each capture once")


def _check_range(anchors: Sequence[Anchor], p: np.void) -> None:
    """Check that most rests lie within the voltage range of the OCV curve.

    Raises:
        UserError: Most rests lie outside the curve, which belongs to another cell.
    """
    low_v, high_v = float(p["ocv_v"][0]), float(p["ocv_v"][-1])
    beyond = [
        anchor
        for anchor in anchors
        if max(low_v - anchor.rest.ocv_v, anchor.rest.ocv_v - high_v)
        > MAX_BEYOND_CURVE_STDS * np.hypot(anchor.own_std_v, anchor.curve_std_v)
    ]
    if 2 * len(beyond) > len(anchors):
        volts = [anchor.rest.ocv_v for anchor in beyond]
        raise UserError(
            f"no capacity: {len(beyond)} of {len(anchors)} rests, at {min(volts):.3f}..{max(volts):.3f} V, are beyond the "
            f"curve of the cell, {low_v:.3f}..{high_v:.3f} V: check the cell file and its number of cells in series"
        )


def continuous_parts(good: SampleBlock, capacity_ah: float) -> list[tuple[int, int]]:
    """Split a capture at gaps with unknown charge. Each part is (first index, index after the last)."""
    step_s = np.diff(good["time_s"])
    if not step_s.size:
        return [(0, good.size)]
    charge_ah = np.abs(good["current_a"][:-1]) * step_s / 3600.0
    gap = np.r_[(step_s > MIN_GAP_PERIODS * np.median(step_s)) & (charge_ah > MIN_GAP_CHARGE * capacity_ah), True]
    edges = np.r_[0, np.flatnonzero(gap) + 1]
    return [(int(first), int(end)) for first, end in itertools.pairwise(edges) if end - first > 1]


def append_anchors(
    name: str, part: int, good: SampleBlock, p: np.void, anchors: list[Anchor], rejected: list[str]
) -> None:
    """Append the anchors of a continuous part to ``anchors`` and the reasons for rejected rests to ``rejected``."""
    capacity_ah, series = p["capacity_as"] / 3600.0, int(p["series"])
    step_ah = good["current_a"][:-1] * np.diff(good["time_s"]) / 3600.0
    counted_ah, throughput_ah = np.r_[0.0, np.cumsum(step_ah)], np.r_[0.0, np.cumsum(np.abs(step_ah))]
    soc = -counted_ah / capacity_ah
    resting = resting_samples(good, capacity_ah)
    rests, reasons = find_rests(good, soc, resting, series)
    rejected += [f"{name}: {line}" for line in reasons]
    after_charge, after_discharge = (
        hysteresis(good["time_s"], soc, float(p["hysteresis_soc"]), initial) for initial in (1.0, -1.0)
    )
    ends = {float(good["time_s"][first]): last - 1 for first, last in true_runs(resting)}
    for rest in rests:
        end = ends[rest.start_s]
        # the initial hysteresis is unknown, from after a discharge to after a charge
        mean_and_std = (
            0.5 * (after_charge[end] + after_discharge[end]),
            math.hypot(HYSTERESIS_STD, 0.5 * HYST_STD * (after_charge[end] - after_discharge[end])),
        )
        anchor = _anchor(name, part, rest, p, mean_and_std, (float(counted_ah[end]), float(throughput_ah[end])))
        if anchor.soc_std > MAX_ANCHOR_SOC_STD:
            rejected.append(
                f"{_location(anchor)}: {rest.ocv_v:.4f} V determines SOC to +-{anchor.soc_std:.2f} only, because the curve "
                f"has a slope of {anchor.slope_v:.3f} V and an error of {1e3 * anchor.curve_std_v:.0f} mV"
            )
        else:
            anchors.append(anchor)


def _anchor(
    name: str, part: int, rest: Rest, p: np.void, hysteresis: tuple[float, float], charge_ah: tuple[float, float]
) -> Anchor:
    """Return the anchor of a rest.

    Args:
        name: Name of the capture.
        part: Number of the continuous part.
        rest: The rest.
        p: Record of dtype EKF_SETTINGS.
        hysteresis: Mean and std of the hysteresis state h.
        charge_ah: Net charge and charge throughput since the part began [Ah].
    """
    series, curve = p["series"], (p["ocv_v"], p["ocv_slope_v"])
    temperature_c = float(np.nan_to_num(rest.temperature_c, nan=REFERENCE_C))
    above_reference_k = temperature_c - REFERENCE_C
    hysteresis_mean, hysteresis_std = (arrhenius(HYSTERESIS_J, temperature_c) * part for part in hysteresis)
    soc = soc_from_ocv(rest.ocv_v, *curve)
    for _ in range(OFFSET_ITERATIONS):
        offset_v = hysteresis_mean * on_grid(soc, p["hysteresis_v"]) + above_reference_k * on_grid(
            soc, p["per_kelvin_v"]
        )
        soc = soc_from_ocv(rest.ocv_v - offset_v, *curve)
    cold_v = COLD_V * float(coldness(np.array([rest.temperature_c]))[0]) * min(1.0, LONG_REST_S / rest.duration_s)
    own_std_v = np.sqrt(
        rest.std_v**2 + (series * (RELAXED_V + cold_v)) ** 2 + (hysteresis_std * on_grid(soc, p["hysteresis_v"])) ** 2
    )
    curve_std_v = on_grid(soc, p["curve_error_v"])
    slope_v = (ocv(soc + SLOPE_SOC, *curve) - ocv(soc - SLOPE_SOC, *curve)) / (2.0 * SLOPE_SOC)
    return Anchor(
        capture=name,
        part=part,
        time_s=rest.start_s + rest.duration_s,
        rest=rest,
        soc=soc,
        soc_std=float(np.hypot(own_std_v, curve_std_v) / slope_v),
        counted_ah=charge_ah[0],
        throughput_ah=charge_ah[1],
        slope_v=float(slope_v),
        own_std_v=float(own_std_v),
        curve_std_v=float(curve_std_v),
    )


def _check_swing(anchors: Sequence[Anchor], rejected: Sequence[str], capacity_ah: float) -> None:
    """Check that the anchors of a part span enough SOC.

    Raises:
        UserError: There are no anchors, or their SOCs are too close.
    """
    reasons = "".join(f"\n  {line}" for line in rejected[:8])
    if not anchors:
        raise UserError(
            "no capacity: no two rests give an SOC with the charge between them counted; rest the cell for half an hour "
            f"near full and again near empty, or give a whole slow discharge to `ocv`{':' if reasons else ''}{reasons}"
        )
    parts = [[anchor for anchor in anchors if anchor.part == part] for part in {anchor.part for anchor in anchors}]
    soc_span = max(np.ptp([anchor.soc for anchor in part]) for part in parts)
    counted_span = max(np.ptp([anchor.counted_ah for anchor in part]) for part in parts) / capacity_ah
    if soc_span < MIN_SOC_SPAN <= 0.5 * counted_span:
        raise UserError(
            f"no capacity: the voltages of the rests are at most {soc_span:.2f} of SOC apart, the charge between them is "
            f"{counted_span:.2f} of the declared capacity: check the curve of the cell file, and that the current is in ampere"
        )
    if soc_span < MIN_SOC_SPAN:
        raise UserError(
            f"no capacity: the anchors of a capture are at most {soc_span:.2f} of SOC apart, at least {MIN_SOC_SPAN} are "
            f"needed: rest again after more charge{':' if reasons else ''}{reasons}"
        )


def _solve(anchors: Sequence[Anchor], rejected: Sequence[str], p: np.void) -> Capacity:
    """Solve for 1/Q, offset/Q and each part's first SOC by generalized least squares."""
    capacity_ah = float(p["capacity_as"]) / 3600.0
    parts = sorted({anchor.part for anchor in anchors})
    soc, counted_ah = (np.array([getattr(anchor, name) for anchor in anchors]) for name in ("soc", "counted_ah"))
    time_h = np.array([anchor.time_s for anchor in anchors]) / 3600.0
    part_indicator = np.array([[float(anchor.part == part) for part in parts] for anchor in anchors])
    model_rows = np.column_stack([-counted_ah, time_h, part_indicator])
    precision = np.linalg.inv(_covariance(anchors, p))
    prior = np.zeros((model_rows.shape[1], model_rows.shape[1]))
    offset_a = float(p["offset_c"]) * capacity_ah
    prior[1, 1] = (capacity_ah / max(offset_a, 1e-9)) ** 2
    covariance = np.linalg.inv(model_rows.T @ precision @ model_rows + prior)
    unknowns = covariance @ model_rows.T @ precision @ soc
    residual = soc - model_rows @ unknowns
    freedom = len(anchors) - len(parts) - 1  # the offset has a prior
    reduced_chi_squared = float(residual @ precision @ residual) / freedom if freedom > 0 else 1.0
    covariance *= max(1.0, reduced_chi_squared)
    relative_std = float(np.sqrt(covariance[0, 0]) / abs(unknowns[0]))
    if unknowns[0] < 0.0 and relative_std < MAX_RELATIVE_CAPACITY_STD:
        raise UserError(
            "no capacity: the voltages of the rests rise where charge is counted out of the cell: "
            "check the sign of the current (--current-sign)"
        )
    if reduced_chi_squared > MAX_REDUCED_CHI_SQUARED:
        raise UserError(
            f"no capacity: voltages and charge of {len(anchors)} anchors disagree by {np.sqrt(reduced_chi_squared):.1f} "
            f"times their expected errors: check the curve of the cell file, and that all captures are of one cell"
        )
    if unknowns[0] <= 0.0 or relative_std > MAX_RELATIVE_CAPACITY_STD:
        raise UserError(
            f"no capacity: {len(anchors)} anchors determine it to {100.0 * relative_std:.0f} % only: give longer rests, further "
            "apart, or a cell file with a more exact curve"
        )
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


def _covariance(anchors: Sequence[Anchor], p: np.void) -> Floats:
    """Return the covariance of the anchors' SOCs that follows from the errors of voltage, curve and charge count."""
    soc, slope_v, own_std_v, curve_std_v, throughput_ah, part = (
        np.array([getattr(a, name) for a in anchors])
        for name in ("soc", "slope_v", "own_std_v", "curve_std_v", "throughput_ah", "part")
    )
    correlation = np.exp(-np.abs(soc[:, None] - soc) / CURVE_SOC)
    from_voltage = (np.diag(own_std_v**2) + correlation * np.outer(curve_std_v, curve_std_v)) / np.outer(
        slope_v, slope_v
    )
    from_counting = p["charge_error"] ** 2 * np.minimum.outer(throughput_ah, throughput_ah) * 3600.0 / p["capacity_as"]
    return np.asarray(from_voltage + np.where(part[:, None] == part, from_counting, 0.0))


def _location(anchor: Anchor) -> str:
    return f"{anchor.capture}: rest until {anchor.time_s:.0f} s"
