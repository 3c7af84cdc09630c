"""Charge by the integral of a sampled current: samples, gaps, and steps back in time."""

import numpy as np
import pytest

from bms_estimator.model.charge_count import charge_ah, gap_warnings, step_charges_as
from bms_estimator.model.unmeasured_time import MAX_FLOW_S


def samples(gap_s, before_a=2.0, after_a=2.0):
    """Return times and currents of 101 samples at 1 Hz before a gap and 100 samples after it."""
    time_s = np.r_[np.arange(101.0), 100.0 + gap_s + np.arange(100.0)]
    return time_s, np.r_[np.full(101, before_a), np.full(100, after_a)]


def test_a_current_is_constant_until_the_next_sample() -> None:
    charge = charge_ah(np.array([0.0, 1800.0, 3600.0, 3600.0]), np.array([1.0, -3.0, 5.0, 0.0]))
    assert charge.tolist() == [0.0, 0.5, -1.0, -1.0]


@pytest.mark.parametrize(
    ("gap_s", "before_a", "after_a", "expected_a"),
    [
        (1800.0, 2.0, 2.0, 2.0),
        (1800.0, 2.0, 0.5, 0.5),
        (1800.0, -0.5, -2.0, -0.5),
        (1800.0, 2.0, 0.0, 0.0),
        (1800.0, -0.7, 2.0, 0.0),
        (50.0, 2.0, 0.0, 2.0),
        (4.0 * MAX_FLOW_S, 2.0, 2.0, 0.0),
        (4.0 * MAX_FLOW_S, -0.7, 2.0, 0.0),
    ],
)
def test_a_gap_carries_the_smaller_current_of_its_ends_and_a_gap_of_hours_none(
    gap_s, before_a, after_a, expected_a
) -> None:
    assert step_charges_as(*samples(gap_s, before_a, after_a))[100] == pytest.approx(expected_a * gap_s)


def test_a_source_with_a_period_of_hours_has_no_gaps() -> None:
    time_s = 7200.0 * np.arange(20.0)
    assert charge_ah(time_s, np.ones(20))[-1] == pytest.approx(38.0)
    assert gap_warnings(time_s, np.ones(20)) == []


def test_a_gap_of_hours_beside_a_load_is_named_with_both_currents() -> None:
    (line,) = gap_warnings(*samples(16_000.0, -0.7, 1.0))
    assert (
        "gaps beside a load: 1; the first begins at 100 s and lasts 16000 s, with -0.7 A before and 1 A after it"
        in line
    )
    assert gap_warnings(*samples(16_000.0, 0.0, 0.0)) == []
    assert gap_warnings(*samples(1800.0, -0.7, 1.0)) == []
