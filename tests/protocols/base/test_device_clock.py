"""Timestamps of a device place its samples, unless they are implausible."""

import itertools
from math import nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.protocols.base.device_clock import LAG_S, DeviceClock
from bms_estimator.protocols.devices.text import TextProtocol


@pytest.mark.parametrize(
    ("stamps", "placed", "jumps"),
    [
        ([(10, 7.0), (11.5, 8.0), (12, 9.0)], [0, 1, 2], 0),  # told ones count, late or not
        ([(10, 7.0), (70, 8.0), (70, 9.0), (70, 10.0)], [0, 1, 2, 3], 0),  # waited for a minute, then came at once
        ([(10, 7.0), (11, 8.0), (12, 0.5), (13, 1.5)], [0, 1, 2, 3], 1),  # began anew
        ([(10, 7.0), (11, 3608.0), (12, 3609.0)], [0, 1, 2], 1),  # was set
        ([(10, nan), (12, nan), (13, 5.0), (14, 6.0)], [0, 2, 3, 4], 0),
        ([(10, 0.0), (15, 0.0), (21, 0.0), (25, 0.0)], [0, 0, 11, 11], 1),  # stands still
    ],
)
def test_times(stamps: list[tuple[float, float]], placed: list[float], jumps: int):
    clock = DeviceClock()
    assert [clock.sample_time(*stamp) for stamp in stamps] == placed
    assert clock.jumps == jumps


def test_a_clock_that_is_slow_loses_no_time():
    clock = DeviceClock()
    placed = [clock.sample_time(float(second), 1e-3 * second) for second in range(200)]
    assert placed[-1] == pytest.approx(199.0)
    assert max(b - a for a, b in itertools.pairwise(placed)) <= LAG_S + 2.0
    assert clock.jumps == 1


def test_bursts_are_no_slow_clock():
    clock = DeviceClock()
    placed = [clock.sample_time(100.0 * (second // 100 + 1), float(second)) for second in range(1000)]
    assert placed == [float(second) for second in range(1000)]
    assert clock.jumps == 0


@given(st.lists(st.tuples(st.floats(0, 10), st.floats() | st.just(1.0))))
def test_time_never_decreases_or_leads_the_arrivals(stamps: list[tuple[float, float]]):
    clock, arrival_s, last_s = DeviceClock(), 0.0, 0.0
    for step_s, told_s in stamps:
        arrival_s += step_s
        placed_s = clock.sample_time(arrival_s, told_s)
        assert placed_s >= last_s
        last_s = placed_s


def test_a_line_tells_its_time_in_seconds():
    decoder = TextProtocol()
    times = [
        decoder.feed(at, b'{"voltage":1,"current":0,"time_s":%.1f}\n' % told)["time_s"][0]
        for at, told in [(1, 5), (9, 6.5)]
    ]
    assert times == [0.0, 1.5]
