"""Counts of false alarms and leads, and the split of a capture into discharges, on made-up signals."""

import math

import numpy as np

from tests.benchmarks.collapse.curve import best, point
from tests.benchmarks.collapse.signals import SIGNALS, Discharge, discharge_ranges


def made_up(*, cutoff_s: float, raised_s: tuple[tuple[float, float], ...]) -> tuple[Discharge, np.ndarray]:
    """Return a discharge of two hours, and a signal that is 1 within these intervals [s] and otherwise 0."""
    rows = np.zeros(720, SIGNALS)
    rows["time_s"] = 10.0 * np.arange(rows.size)
    signal = sum(((rows["time_s"] >= begin) & (rows["time_s"] < end)).astype(float) for begin, end in raised_s)
    return Discharge("made up", rows, 2.0, cutoff_s, 3.0, is_simulated=True), signal + np.zeros(rows.size)


def test_an_alarm_is_false_unless_the_cut_off_follows_within_15_min() -> None:
    cases = [
        made_up(cutoff_s=7200.0, raised_s=((1000.0, 1500.0), (7000.0, 7200.0))),  # false, and 190 s ahead
        made_up(cutoff_s=7200.0, raised_s=((7170.0, 7200.0),)),  # 20 s ahead
        made_up(cutoff_s=7200.0, raised_s=()),
        made_up(cutoff_s=math.nan, raised_s=((3000.0, 3100.0),)),  # false
    ]
    found, signals = zip(*cases, strict=True)
    result = point(found, signals, 0.5, 0.5)
    assert result.false_in_100_h == 100.0 * 2 / 8.0
    assert (result.raised, result.ahead) == (2 / 3, 1 / 3)
    assert result.median_lead_s == 0.5 * (190.0 + 20.0)  # each alarm is raised after its delay of 10 s
    assert best([result], 30.0) == result
    assert best([result], 20.0) is None


def test_an_alarm_that_is_raised_too_early_and_stays_is_false_and_warns() -> None:
    found, signal = made_up(cutoff_s=7200.0, raised_s=((3000.0, 7200.0),))
    result = point([found], [signal], 0.5, 0.5)
    assert (result.false_in_100_h, result.ahead, result.median_lead_s) == (50.0, 1.0, 900.0)


def test_a_charge_of_5_percent_ends_a_discharge_but_regeneration_does_not() -> None:
    drawn = [0.0, 0.2, 0.17, 0.5, 0.4, 0.1, 0.12, 0.3]
    assert list(discharge_ranges(drawn)) == [(0, 4), (5, 8)]
