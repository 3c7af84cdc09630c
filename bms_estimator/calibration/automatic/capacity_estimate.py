"""Capacity with which the SOC of captures is counted: the measured capacity, or else the rated capacity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.capacity import measure_capacity
from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.ocv.slow_curve import measured_capacity_ah, slow_branches
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

MAX_RESTS_STD = 0.03
"""Maximum relative standard deviation of a capacity from rests. The OCV curve of a generic cell gives 5 to 10 %, which is no
better than a rated capacity, or 2 % between a rest when full and a rest when empty. The cell's own curve gives 1 to 2 %."""


@dataclass(frozen=True)
class CapacityEstimate:
    """Capacity of one cell.

    Attributes:
        capacity_ah: Capacity [Ah].
        origin: Origin of the value for messages, such as ``measured by 5 rests``.
        from_slow_discharge: True if a slow discharge from full to empty measured it.
    """

    capacity_ah: float
    origin: str
    from_slow_discharge: bool = False


def estimate_capacity(captures: Sequence[Columns], rated: CellModel) -> CapacityEstimate:
    """Return the capacity of a cell.

    It comes from the first of these sources that is available:

    1. the charge of a slow discharge from full to empty
    2. the SOC differences between rests, if the std of the result is small
    3. the largest charge that a capture draws, if it exceeds the rated capacity
    4. the rated capacity

    Args:
        captures: Captures of one cell.
        rated: Cell with the rated capacity, and an OCV that gives the SOC of rests.

    Raises:
        UserError: A capture has too few good samples, or the wrong sign of the current.
    """
    good = {capture.name: remove_glitches(capture.rows, capture.name) for capture in captures}
    branches = [branch for name, samples in good.items() for branch in slow_branches(samples, name)]
    slow_ah = measured_capacity_ah(branches)
    if np.isfinite(slow_ah):
        return CapacityEstimate(slow_ah, "measured by a slow discharge from full to empty", from_slow_discharge=True)
    name, drawn_ah = max(((name, _largest_swing_ah(samples)) for name, samples in good.items()), key=lambda x: x[1])
    rated_ah = rated.cell.capacity_ah
    try:
        measured = measure_capacity(captures, rated)
    except UserError:  # too few rests, or a curve that is too inexact
        measured = None
    if (
        measured is not None
        and measured.std_ah < MAX_RESTS_STD * measured.capacity_ah
        and measured.capacity_ah > drawn_ah
    ):
        return CapacityEstimate(
            measured.capacity_ah, f"measured by {len(measured.anchors)} rests, ± {measured.std_ah:.2g} Ah"
        )
    if drawn_ah > rated_ah:
        return CapacityEstimate(drawn_ah, f"drawn in {name}, more than the rated {rated_ah:g} Ah")
    return CapacityEstimate(rated_ah, "rated; no capture measures it")


def _largest_swing_ah(good: SampleBlock) -> float:
    """Return the largest difference of the counted charge within a capture [Ah]."""
    counted_ah = np.cumsum(good["current_a"][:-1] * np.diff(good["time_s"])) / 3600.0
    return float(np.ptp(np.r_[0.0, counted_ah]))
