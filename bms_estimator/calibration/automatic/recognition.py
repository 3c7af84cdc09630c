"""Recognition of what a capture determines: open-circuit voltage, resistances, and the capacity that counts its SOC."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.capacity import measure_capacity
from bms_estimator.calibration.cleaning.capture_checks import (
    FULL_SOC,
    StartOrigin,
    StartSoc,
    starts_of,
    without_excitation,
)
from bms_estimator.calibration.cleaning.clean_capture import (
    CleanCapture,
    clean_capture,
    mean_temperature_c,
    remove_glitches,
    resting_samples,
    true_runs,
)
from bms_estimator.calibration.ocv.chen_mora_fit import MIN_SPAN
from bms_estimator.calibration.ocv.relaxation_test import MIN_POINTS, RelaxationTest, relaxation_test
from bms_estimator.calibration.ocv.slow_branch import SlowBranch, measured_capacity_ah, slow_branches
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.model.charge_count import charge_ah
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError

MAX_PULSE_S = 60.0
"""Maximum duration of a pulse [s]. The pulses of an HPPC test last 10 to 30 s."""
MAX_CURRENT_DEVIATION = 0.05
"""Maximum relative deviation of a load's current from its median for a constant current."""
CONSTANT_FRACTION = 0.9
"""Minimum fraction of a load's samples at the median current for a constant current."""

MIN_OCV_REST_S = 120.0
"""Minimum duration of the rests that measure an open-circuit voltage [s]. In a rest of a minute, a cell relaxes by about half, so
that the curve is an estimate."""
MIN_HIGHEST_SOC = 0.9
"""Minimum highest SOC of captures that determine the open-circuit voltage, because the curve above it is extrapolated."""


@dataclass(frozen=True)
class RecognizedCapture:
    """Capture, and what it determines.

    Attributes:
        capture: The capture.
        good: Its samples without glitches, dtype ``SAMPLE``.
        kind: Kind of the test, such as "relaxation test, 19 rests".
        slow_branches: Low-rate discharges and charges; empty if there are none.
        start: SOC at the first sample.
        reaches_full: True if the capture alone suffices for an open-circuit voltage: its first SOC was given, or its SOC is
            known and comes near 1.
        is_ocv_test: True if the capture has low-rate curves or enough rests for an open-circuit voltage.
        gives_ocv: True if the capture determines the open-circuit voltage.
        measures_ocv: True if low-rate curves, or enough rests of some minutes, determine the open-circuit voltage.
        gives_resistances: True if its current is large enough for resistances.
        temperature_c: Mean temperature [°C]; NaN without a sensor.
    """

    capture: Columns
    good: SampleBlock
    kind: str
    slow_branches: tuple[SlowBranch, ...]
    start: StartSoc
    reaches_full: bool
    is_ocv_test: bool
    gives_ocv: bool
    measures_ocv: bool
    gives_resistances: bool
    temperature_c: float

    @property
    def contradicts_start(self) -> bool:
        """True if the rests would determine an OCV, but their charge contradicts the SOC from the first voltage."""
        is_by_voltage = self.start.origin is StartOrigin.VOLTAGE
        return is_by_voltage and self.is_ocv_test and not self.slow_branches and not self.gives_ocv

    @property
    def determined(self) -> str:
        """Values that the capture determines, for a table."""
        ocv = "OCV" if self.measures_ocv else "OCV (short rests)"
        values = [ocv] * self.gives_ocv + ["resistances"] * self.gives_resistances
        return ", ".join(values) or "none"

    def with_capture(self, part: Columns) -> "RecognizedCapture":
        """Return a copy with only a part of the samples."""
        return replace(self, capture=part, good=part.rows)


def recognize(
    captures: Sequence[Columns], cell: CellModel, initial_soc: float | None = None
) -> list[RecognizedCapture]:
    """Recognize the kinds of captures.

    Args:
        captures: Captures of one cell.
        cell: Cell with the capacity that SOC is counted against, and with the limits of valid samples.
        initial_soc: SOC 0..1 of the captures that start at the highest voltage; None: by their voltages.

    Raises:
        UserError: A capture has too few good samples, or the wrong sign of the current.
    """
    cleaned = [clean_capture(capture.name, capture.rows, cell) for capture in captures]
    starts = starts_of(cleaned, cell, initial_soc)
    return [
        _recognize(capture, clean, start, cell) for capture, clean, start in zip(captures, cleaned, starts, strict=True)
    ]


def _recognize(capture: Columns, cleaned: CleanCapture, start: StartSoc, cell: CellModel) -> RecognizedCapture:
    good = remove_glitches(capture.rows, capture.name)
    slow = tuple(slow_branches(good, capture.name, start))
    test = None if slow else _relaxation_test(capture, start.soc, cell)
    # a test whose SOC is unknown or contradicts the charge still shows the kind of the capture
    test_of_unknown_soc = None if slow or test is not None else _relaxation_test(capture, 1.0, cell)
    if slow:
        kind = " and ".join(branch.label(cell.cell.capacity_ah) for branch in slow)
    elif (any_test := test or test_of_unknown_soc) is not None:
        kind = f"{_kind_of_test(good, cell)}, {len(any_test.rests)} rests"
    else:
        kind = _kind_of_load(good, cell)
    return RecognizedCapture(
        capture=capture,
        good=good,
        kind=kind,
        slow_branches=slow,
        start=start,
        reaches_full=start.origin is StartOrigin.GIVEN or _highest_soc(slow, test, cell) >= MIN_HIGHEST_SOC,
        is_ocv_test=bool(slow) or test is not None or test_of_unknown_soc is not None,
        gives_ocv=_are_curves_usable(slow, cell) or test is not None,
        measures_ocv=bool(slow) or (test is not None and _has_long_rests(test)),
        gives_resistances=not without_excitation(cleaned, cell),
        temperature_c=mean_temperature_c(good),
    )


def _relaxation_test(capture: Columns, initial_soc: float, cell: CellModel) -> RelaxationTest | None:
    """Return the relaxation test of a capture; None if its rests do not determine an open-circuit voltage.

    ``initial_soc`` is the SOC at the first sample; NaN if it is unknown, so that the rests determine nothing.
    """
    if np.isnan(initial_soc):
        return None
    try:
        test = relaxation_test(capture.rows, cell.cell.capacity_ah, initial_soc=initial_soc, name=capture.name)
    except UserError:  # too few rests, a charge, or a charge that contradicts the SOC
        return None
    return test if np.ptp(test.soc) >= MIN_SPAN else None


def _has_long_rests(test: RelaxationTest) -> bool:
    """Return True if enough rests are long enough for the open-circuit voltage."""
    return sum(rest.duration_s >= MIN_OCV_REST_S for rest in test.rests) >= MIN_POINTS


def _are_curves_usable(slow: Sequence[SlowBranch], cell: CellModel) -> bool:
    """Return True if low-rate curves are long enough, and their SOC is known.

    The SOC of discharges is known if the SOC at their start is. Without a discharge, charges must end with a full cell.
    """
    if max((branch.ah[-1] for branch in slow), default=0.0) < MIN_SPAN * cell.cell.capacity_ah:
        return False
    discharges = [branch for branch in slow if not branch.charge]
    if discharges:
        return all(np.isfinite(branch.start.soc) for branch in discharges)
    return all(branch.voltage_v[-1] >= branch.start.full_v for branch in slow)


def _highest_soc(slow: Sequence[SlowBranch], test: RelaxationTest | None, cell: CellModel) -> float:
    """Return the highest SOC at which the capture determines the open-circuit voltage; NaN if the SOC is unknown."""
    if test is not None:
        return max(test.start_soc, float(test.soc.max()))
    before = [branch.start.soc - branch.before_ah / cell.cell.capacity_ah for branch in slow if not branch.charge]
    return max(before, default=1.0)


def _kind_of_test(good: SampleBlock, cell: CellModel) -> str:
    """Return the kind of a capture with loads and rests."""
    durations_s = [good["time_s"][last - 1] - good["time_s"][first] for first, last in _loads(good, cell)]
    if np.median(durations_s) <= MAX_PULSE_S:
        return "pulses"
    return "load steps" if _constant_current_a(good, cell) is None else "relaxation test"


def _kind_of_load(good: SampleBlock, cell: CellModel) -> str:
    """Return the kind of a capture that determines no open-circuit voltage."""
    if not _loads(good, cell):
        return "rest"
    current_a = _constant_current_a(good, cell)
    if current_a is None:
        return "varying load"
    return f"constant {'discharge' if current_a > 0.0 else 'charge'} at {abs(current_a) / cell.cell.capacity_ah:.2g} C"


def _constant_current_a(good: SampleBlock, cell: CellModel) -> float | None:
    """Return the current of all loads [A]; None if it varies."""
    current_a = np.concatenate([good["current_a"][first:last] for first, last in _loads(good, cell)])
    middle_a = float(np.median(current_a))
    is_equal = np.abs(current_a - middle_a) <= MAX_CURRENT_DEVIATION * abs(middle_a)
    return middle_a if is_equal.mean() >= CONSTANT_FRACTION else None


def _loads(good: SampleBlock, cell: CellModel) -> list[tuple[int, int]]:
    """Return the first index, and the index after the last, of each load."""
    return true_runs(~resting_samples(good, cell.cell.capacity_ah))


MAX_RESTS_STD = 0.06
"""Maximum relative standard deviation of a capacity from rests. With the OCV of a generic cell, the std is 2 to 6 % if the rests
include one when full and one when empty, and otherwise above 7 %. A rated capacity is exact to some percent for a new cell, and
10 to 20 % too large for an aged one."""

EMPTY_SOC = 0.05
"""SOC whose OCV a capture must reach if its end proves an empty cell. Below, the OCV is steep."""


@dataclass(frozen=True)
class CapacityEstimate:
    """Capacity of one cell.

    Attributes:
        capacity_ah: Capacity [Ah].
        origin: Origin of the value for messages, such as ``drawn in test.csv``.
        relative_std: Standard deviation relative to the capacity; None if it is unknown.
        from_slow_discharge: True if a slow discharge from full to empty measured it.
    """

    capacity_ah: float
    origin: str
    relative_std: float | None = None
    from_slow_discharge: bool = False

    @property
    def is_measured(self) -> bool:
        """True if a slow discharge or rests measured it."""
        return self.from_slow_discharge or self.relative_std is not None


def estimate_capacity(
    captures: Sequence[Columns], rated: CellModel, initial_soc: float | None = None
) -> CapacityEstimate:
    """Return the capacity of a cell.

    The first choice is the charge of a slow discharge from full, or from a given SOC, to empty. The second is the capacity by
    the SOC differences between rests, if its std is small. The third is the rated capacity. If a capture draws more charge
    than the second or third choice, this charge is the capacity: a lower bound, if the cell was not full or not empty.

    Args:
        captures: Captures of one cell.
        rated: Cell with the rated capacity, and an OCV that gives the SOC of rests.
        initial_soc: SOC 0..1 of the captures that start at the highest voltage; None: by their voltages.

    Raises:
        UserError: A capture has too few good samples, or the wrong sign of the current.
    """
    good = {capture.name: remove_glitches(capture.rows, capture.name) for capture in captures}
    cleaned = [clean_capture(capture.name, capture.rows, rated) for capture in captures]
    starts = starts_of(cleaned, rated, initial_soc)
    branches = [
        branch
        for (name, samples), start in zip(good.items(), starts, strict=True)
        for branch in slow_branches(samples, name, start)
    ]
    slow_ah = measured_capacity_ah(branches)
    if np.isfinite(slow_ah):
        begin = "full" if initial_soc is None or initial_soc >= FULL_SOC else f"the given SOC of {initial_soc:g}"
        return CapacityEstimate(
            slow_ah, f"measured by a slow discharge from {begin} to empty", from_slow_discharge=True
        )
    estimate = _rated_or_rests(captures, rated)
    name, drawn_ah = max(
        ((name, largest_swing_ah(samples)) for name, samples in good.items()), key=lambda swing: swing[1]
    )
    if drawn_ah > estimate.capacity_ah:
        start = starts[list(good).index(name)]
        is_whole = start.origin is StartOrigin.FULL and good[name]["voltage_v"].min() < ocv(EMPTY_SOC, *ocv_grid(rated))
        bound = "" if is_whole else "; a lower bound, because the capture does not run from full to empty"
        return CapacityEstimate(
            drawn_ah, f"drawn in {name}, more than the expected {estimate.capacity_ah:.4g} Ah{bound}"
        )
    return estimate


def _rated_or_rests(captures: Sequence[Columns], rated: CellModel) -> CapacityEstimate:
    """Return the capacity from rests if it is exact enough, otherwise the rated capacity."""
    rated_ah = rated.cell.capacity_ah
    try:
        rests = measure_capacity(captures, rated)
    except UserError:  # too few rests, or a curve that is too inexact
        return CapacityEstimate(rated_ah, "rated; no capture measures it")
    relative_std = rests.std_ah / rests.capacity_ah
    if relative_std > MAX_RESTS_STD:
        return CapacityEstimate(rated_ah, f"rated; rests would measure it to {100.0 * relative_std:.0f} % only")
    origin = f"measured by {len(rests.anchors)} rests, ± {rests.std_ah:.2g} Ah"
    return CapacityEstimate(rests.capacity_ah, origin, round(relative_std, 4))


def largest_swing_ah(good: SampleBlock) -> float:
    """Return the largest difference of the counted charge within a capture [Ah]."""
    return float(np.ptp(charge_ah(good["time_s"], good["current_a"])))
