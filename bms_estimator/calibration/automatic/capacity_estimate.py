"""Capacity with which the SOC of captures is counted: from a slow discharge, from rests, or the rated capacity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.capacity import measure_capacity
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.calibration.cleaning.start_soc import FULL_SOC, StartOrigin, starts_of
from bms_estimator.calibration.ocv.slow_branch import measured_capacity_ah, slow_branches
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv
from bms_estimator.model.cell import CellModel
from bms_estimator.model.charge_count import charge_ah
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import SampleBlock

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
