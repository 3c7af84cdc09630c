"""Warnings about given values that the captures contradict: the chemistry and the rated capacity."""

from collections.abc import Sequence

from bms_estimator.calibration.automatic.capacity_estimate import CapacityEstimate, largest_swing_ah
from bms_estimator.calibration.automatic.recognition import RecognizedCapture
from bms_estimator.calibration.cleaning.start_soc import StartOrigin
from bms_estimator.calibration.elements.generic_prior import ocv_rms_difference_v
from bms_estimator.calibration.ocv.table_fit import NODES
from bms_estimator.calibration.ocv_cell import OcvCell
from bms_estimator.model.cell import CellModel, generic_cells, load_cell

MIN_CHEMISTRY_DIFFERENCE_V = 0.25
"""Minimum difference of two RMS voltages that causes a warning [V]. The voltages are the RMS differences from the measured OCV of
the given cell and of the nearest generic cell. The difference is at most 0.19 V among LCO, LMO, NCA and NMC. If only one of the
two cells is LFP or LTO, it is at least 0.34 V with a rated capacity up to 12 % too large."""
MIN_LOW_SOC_RMS_V = 0.1
"""Minimum RMS error at low SOC that suggests a wrong capacity, per cell [V]. With the capacity drawn,
a Leaf cell has 31 mV and an NCR18650 cell 71 mV. With a capacity that is 8 % too large, the Leaf cell has 228 mV."""
MIN_DRAWN_FRACTION = 0.8
"""Minimum fraction of the rated capacity that a capture draws if its end may be an empty cell. Cells usually count
as worn out at 80 % of their rated capacity."""


def unproven_starts(captures: Sequence[RecognizedCapture], given: CellModel) -> list[str]:
    """Return a line on each capture that would determine capacity or OCV if its SOC at the first sample were known.

    Args:
        captures: The captures. The SOC of a capture is read from the OCV curve of others that start at a known SOC.
        given: Cell whose OCV gives the SOC of the first rest.
    """
    lines = []
    has_other_curve = any(each.gives_ocv and each.start.is_exact for each in captures)
    for each in captures:
        ends_full = each.gives_ocv and all(branch.charge for branch in each.slow_branches) and each.slow_branches
        if each.start.is_exact or not each.is_ocv_test or ends_full or (has_other_curve and each.gives_ocv):
            continue
        remedy = (
            "the SOC is counted from there"
            if each.gives_ocv and each.reaches_full
            else "it gives neither capacity nor OCV"
        )
        lines.append(
            f"{each.capture.name}: nothing proves that it starts with a full cell: {each.start.reason} of {given.cell.name}; "
            f"{remedy}; if the SOC at the start is known, give --soc"
        )
    return lines


def chemistry_warnings(given: CellModel, capacity: CapacityEstimate, ocv: OcvCell | None) -> list[str]:
    """Return a warning if the measured OCV belongs to another chemistry than the given generic cell.

    There is no warning if the capacity was measured, because the given cell then determines neither capacity nor OCV.
    """
    if ocv is None or capacity.is_measured or given.cell.name not in generic_cells():
        return []
    generic = load_cell(given.cell.name, given.cell.capacity_ah)
    given_v, nearest_v = (ocv_rms_difference_v(cell, NODES, ocv.fit(NODES)) for cell in (generic, ocv.generic))
    if given_v - nearest_v < MIN_CHEMISTRY_DIFFERENCE_V:
        return []
    nearest = ocv.generic.cell.name
    return [f"the measured OCV fits {nearest} better than {generic.cell.name}: check --cell, or cell in [pack]"]


def capacity_warnings(
    given: CellModel, capacity: CapacityEstimate, captures: Sequence[RecognizedCapture], low_soc_rms_v: float
) -> list[str]:
    """Return a warning on a rated capacity that a capture contradicts.

    Either a slow discharge measures much less, or the rated capacity is used, and the charge drawn from full may be the capacity
    instead.

    Args:
        given: Cell with the rated capacity.
        capacity: Capacity that SOC was counted against.
        captures: The captures.
        low_soc_rms_v: RMS error of the model at low SOC, per cell [V]; NaN without samples.
    """
    rated_ah = given.cell.capacity_ah
    if capacity.from_slow_discharge and capacity.capacity_ah < MIN_DRAWN_FRACTION * rated_ah:
        percent = 100.0 * capacity.capacity_ah / rated_ah
        text = f"the slow discharge measures {percent:.0f} % of the rated {rated_ah:.4g} Ah"
        return [f"{text}; if it began below full, give the SOC at its start (--soc)"]
    drawn = [
        (largest_swing_ah(each.good), each.capture.name)
        for each in captures
        if each.gives_ocv and each.start.origin is StartOrigin.FULL
    ]
    if not drawn or capacity.capacity_ah != rated_ah or not low_soc_rms_v > MIN_LOW_SOC_RMS_V:
        return []
    drawn_ah, name = max(drawn)
    if drawn_ah < MIN_DRAWN_FRACTION * rated_ah:
        return []
    return [
        f"{name} draws {drawn_ah:.4g} Ah from full; if it ended when the cell was empty, give --capacity {drawn_ah:.4g}"
    ]
