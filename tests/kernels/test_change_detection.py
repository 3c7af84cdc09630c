"""Hypotheses of a change of a cell's self-discharge."""

import numpy as np
import pytest

from bms_estimator.kernels.cells.cell_filter import (
    END_STD,
    MIN_INFORMATION,
    THRESHOLD_STD,
    apply_changes,
    initialize_cell,
    restart_hypothesis,
)
from bms_estimator.kernels.cells.records import CELL, DRAIN, FALL, HYPOTHESES, LEAK, RISE

INFORMATION = 1e8
"""Information of each hypothesis [h^2]: a std of 1e-4/h."""


def leak_after(significance_std: dict[int, float], information: float = INFORMATION) -> float:
    """Return the self-discharge of a cell after hypotheses with these significances [1/h], and ``information`` [h^2]."""
    cells = np.zeros(1, CELL)
    initialize_cell(cells[0])
    for h in range(HYPOTHESES):
        restart_hypothesis(cells[0], h)
        cells["information"][0, h] = information
        cells["score"][0, h] = significance_std.get(h, 0.0) * np.sqrt(information)
    apply_changes(cells[0])
    return float(cells["mean"][0, LEAK])


@pytest.mark.parametrize(("hypothesis", "sign"), [(RISE, 1.0), (FALL, -1.0)])
def test_a_significant_change_corrects_the_self_discharge(hypothesis: int, sign: float) -> None:
    assert leak_after({hypothesis: THRESHOLD_STD + 2.0}) == pytest.approx(sign * (THRESHOLD_STD + 2.0) * 1e-4)


def test_a_change_below_the_threshold_is_ignored() -> None:
    assert leak_after({RISE: THRESHOLD_STD - 0.1}) == 0.0


def test_a_change_after_a_short_observation_is_ignored() -> None:
    """One wrong innovation has the same effect as a large short."""
    assert leak_after({RISE: THRESHOLD_STD + 2.0}, information=MIN_INFORMATION / 2.0) == 0.0


def test_a_fall_needs_less_significance_than_a_rise() -> None:
    assert leak_after({RISE: END_STD + 1.0}) == 0.0
    assert leak_after({FALL: END_STD + 1.0}) < 0.0


def test_a_rise_that_a_balancer_explains_as_well_is_no_self_discharge() -> None:
    assert leak_after({RISE: THRESHOLD_STD + 2.0, DRAIN: THRESHOLD_STD + 1.9}) == 0.0


def test_a_drain_by_a_balancer_leaves_the_self_discharge_unchanged() -> None:
    assert leak_after({RISE: THRESHOLD_STD + 1.0, DRAIN: THRESHOLD_STD + 2.0}) == 0.0
