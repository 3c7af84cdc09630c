"""Recognition of what a capture determines: the open-circuit voltage, the resistances, or both."""

from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import without_excitation
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.cleaning.rests import (
    mean_temperature_c,
    remove_glitches,
    resting_samples,
    true_runs,
)
from bms_estimator.calibration.ocv.points import MIN_SPAN
from bms_estimator.calibration.ocv.relaxation_test import RelaxationTest, relaxation_test
from bms_estimator.calibration.ocv.slow_curve import SlowBranch, slow_branches
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

MAX_PULSE_S = 60.0
"""Maximum duration of a pulse [s]. The pulses of an HPPC test last 10 to 30 s."""
MAX_CURRENT_DEVIATION = 0.05
"""Maximum relative deviation of a load's current from its median for a constant current."""
CONSTANT_FRACTION = 0.9
"""Minimum fraction of a load's samples at the median current for a constant current."""


@dataclass(frozen=True)
class RecognizedCapture:
    """Capture, and what it determines.

    Attributes:
        capture: The capture.
        good: Its samples without glitches, dtype ``SAMPLE``.
        kind: Kind of the test, such as "relaxation test, 19 rests".
        slow_branches: Low-rate discharges and charges; empty without any.
        gives_ocv: True if the capture determines the open-circuit voltage.
        gives_resistances: True if its current is large enough for resistances.
        temperature_c: Mean temperature [°C]; NaN without a sensor.
    """

    capture: Columns
    good: SampleBlock
    kind: str
    slow_branches: tuple[SlowBranch, ...]
    gives_ocv: bool
    gives_resistances: bool
    temperature_c: float

    @property
    def determined(self) -> str:
        """Values that the capture determines, for a table."""
        values = ["OCV"] * self.gives_ocv + ["resistances"] * self.gives_resistances
        return ", ".join(values) or "none"

    def with_capture(self, part: Columns) -> "RecognizedCapture":
        """Return a copy with only a part of the samples."""
        return replace(self, capture=part, good=part.rows)


def recognize(capture: Columns, cell: CellModel) -> RecognizedCapture:
    """Recognize the kind of a capture.

    Args:
        capture: Samples of one cell.
        cell: Cell with the capacity that SOC is counted against, and with the limits of valid samples.

    Raises:
        UserError: The capture has too few good samples, or the wrong sign of the current.
    """
    good = remove_glitches(capture.rows, capture.name)
    cleaned = clean_capture(capture.name, capture.rows, cell)
    slow = tuple(slow_branches(good, capture.name))
    test = None if slow else _relaxation_test(capture, cell)
    if slow:
        kind = " and ".join(branch.label(cell.cell.capacity_ah) for branch in slow)
    elif test is not None:
        kind = f"{_kind_of_test(good, cell)}, {len(test.rests)} rests"
    else:
        kind = _kind_of_load(good, cell)
    return RecognizedCapture(
        capture=capture,
        good=good,
        kind=kind,
        slow_branches=slow,
        gives_ocv=bool(slow) or test is not None,
        gives_resistances=not without_excitation(cleaned, cell),
        temperature_c=mean_temperature_c(good),
    )


def _relaxation_test(capture: Columns, cell: CellModel) -> RelaxationTest | None:
    """Return the relaxation test of a capture; None if its rests do not determine an open-circuit voltage."""
    try:
        test = relaxation_test(capture.rows, cell.cell.capacity_ah, name=capture.name)
    except UserError:  # too few rests, or a charge
        return None
    return test if np.ptp(test.soc) >= MIN_SPAN else None


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
