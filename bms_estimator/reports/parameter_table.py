"""Table of a cell's parameters: cell file, estimates, standard deviations and verdicts."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from bms_estimator.estimator.stability_conditions import failed_conditions
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.plot.cell_curves import ELEMENTS, SocCurve, element_over_soc, stability_limits
from bms_estimator.reports.formats import number
from bms_estimator.reports.report_page import Group

TABULATED_SOC = (0.2, 0.5, 0.8)
"""SOCs of the table."""
MAX_SOC_DISTANCE = 0.05
"""Maximum distance of an estimate's SOC from the SOC in the table."""
MAX_RELATIVE_STD = 0.5
"""Relative std above which a capture does not determine a parameter."""


def parameter_group(
    cell: CellModel, estimates: Mapping[str, Floats], capacity_ah: float, capacity_std_ah: float
) -> Group:
    """Return the table of circuit elements and capacity, with the stability of the elements as its remark.

    Args:
        cell: Cell that the estimates started from.
        estimates: Columns of the trace by name.
        capacity_ah: Learned capacity [Ah].
        capacity_std_ah: Standard deviation of the learned capacity [Ah].
    """
    rated_ah, rated_std = cell.cell.capacity_ah, cell.cell.capacity_std or math.nan
    capacity = _values_and_verdict(rated_ah, rated_std * rated_ah, capacity_ah, capacity_std_ah)
    rows = [*_element_rows(cell, estimates), ("capacity [Ah]", "", *capacity)]
    return Group(
        "Parameters",
        columns=("parameter", "SOC", "cell file", "std", "estimated", "std", "verdict"),
        rows=tuple(rows),
        remark="“agrees”: the difference is at most 2 standard deviations. “not determined”: the std of the estimate exceeds "
        f"{100 * MAX_RELATIVE_STD:.0f} % of its value. The std of the cell file is that between cells of its type. {_stability(cell)}",
    )


def _element_rows(cell: CellModel, estimates: Mapping[str, Floats]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each circuit element and SOC of the table."""
    relative_std = cell.ladder.std if cell.ladder else math.nan
    for name, (function, scale, label) in ELEMENTS.items():
        curve = element_over_soc(estimates, name)
        for soc in TABULATED_SOC:
            from_file = scale * function(soc, cell.a[:16])
            value, std = _nearest(curve, soc)
            texts = _values_and_verdict(from_file, relative_std * from_file, scale * value, scale * std)
            yield (label, f"{100 * soc:.0f} %", *texts)


def _nearest(curve: SocCurve, soc: float) -> tuple[float, float]:
    """Return the estimate at the SOC nearest to ``soc``, and its std; NaN if it is farther than ``MAX_SOC_DISTANCE``."""
    distance = np.abs(curve.soc - soc)
    if distance.size == 0 or distance.min() > MAX_SOC_DISTANCE:
        return math.nan, math.nan
    nearest = int(np.argmin(distance))
    return float(curve.value[nearest]), float(curve.std[nearest])


def _values_and_verdict(from_file: float, file_std: float, value: float, std: float) -> tuple[str, ...]:
    return (
        number(from_file),
        number(file_std, 2),
        number(value),
        number(std, 2),
        verdict_on_parameter(from_file, file_std, value, std),
    )


def verdict_on_parameter(from_file: float, file_std: float, value: float, std: float) -> str:
    """Return the verdict on an estimate: ``not covered``, ``not determined``, ``agrees`` or ``differs``.

    Args:
        from_file: Value in the cell file.
        file_std: Standard deviation of ``from_file``; NaN if unknown.
        value: Estimate; NaN without one.
        std: Standard deviation of ``value``.
    """
    if not math.isfinite(value):
        return "not covered"
    if not std <= MAX_RELATIVE_STD * abs(value):
        return "not determined"
    known_std = file_std if math.isfinite(file_std) else 0.0
    return "agrees" if abs(value - from_file) <= 2.0 * math.hypot(known_std, std) else "differs"


def _stability(cell: CellModel) -> str:
    """Return sentences on the SOCs at which the capacitances become negative, and on the conditions of Lemma 4.1.1."""
    limits = {name: max(soc, 0.0) for name, soc in stability_limits(cell).items()}
    positive = "; ".join(
        f"{name.replace('c_', 'C_')} is positive above SOC {100 * soc:.1f} %" for name, soc in limits.items()
    )
    failed = failed_conditions(cell)
    conditions = (
        f"These required conditions fail: {', '.join(condition.name for condition in failed)}."
        if failed
        else "All required conditions hold."
    )
    return f"Stability (Lemma 4.1.1 of the thesis): {positive}. {conditions}"
