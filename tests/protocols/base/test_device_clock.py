"""Sample times from a device's timestamps, or from the arrival times if the timestamps are implausible."""

import itertools
from math import nan

import pytest
from hypothesis import given, strategies as st

from bms_estimator.protocols.base.device_clock import MAX_FIRST_BACKLOG_S, MAX_LEAD_S, DeviceClock
from bms_estimator.protocols.devices.text import TextProtocol


@pytest.mark.parametrize(
    ("arrivals_and_stamps", "times_s", "jumps"),
    [
        ([(10, 7.0), (11.5, 8.0), (12, 9.0)], [0, 1, 2], 0),
        ([(10, 7.0), (70, 8.0), (70, 9.0), (70, 10.0)], [0, 1, 2, 3], 0),
        ([(10, 7.0), (11, 8.0), (12, 0.5), (13, 1.5)], [0, 1, 2, 3], 1),
        ([(10, 7.0), (11, 3608.0), (12, 3609.0)], [0, 1, 2], 1),
        ([(10, nan), (12, nan), (13, 5.0), (14, 6.0)], [0, 2, 3, 4], 0),
        # arrival times are used once a timestamp has been constant for 10 s
        ([(10, 0.0), (15, 0.0), (21, 0.0), (25, 0.0)], [0, 0, 11, 11], 1),
    ],
    ids=["delayed by 0.5 s", "delayed by a minute", "restarted", "set ahead", "without timestamps", "constant"],
)
def test_sample_times_follow_the_timestamps_unless_those_are_implausible(
    arrivals_and_stamps: list[tuple[float, float]], times_s: list[float], jumps: int
):
    clock = DeviceClock()
    assert [clock.sample_time(arrival_s, stamp_s) for arrival_s, stamp_s in arrivals_and_stamps] == times_s
    assert clock.jumps == jumps


def test_time_lost_by_a_slow_clock_is_added():
    """The device's clock counts one millisecond in each second."""
    clock = DeviceClock()
    times_s = [clock.sample_time(float(second), 1e-3 * second) for second in range(200)]
    assert times_s[-1] == pytest.approx(199.0)
    assert max(b - a for a, b in itertools.pairwise(times_s)) == pytest.approx(
        30.0, abs=1.0
    )  # one step adds the lost time
    assert clock.jumps == 1


def test_clock_of_samples_that_arrive_in_bursts_does_not_count_as_slow():
    clock = DeviceClock()
    # a burst of 100 samples arrives every 100 s
    times_s = [clock.sample_time(100.0 * (second // 100 + 1), float(second)) for second in range(1000)]
    assert times_s == [float(second) for second in range(1000)]
    assert clock.jumps == 0


@given(st.lists(st.tuples(st.floats(0, 10), st.floats() | st.just(1.0))))
def test_sample_time_never_decreases(arrival_steps_and_stamps: list[tuple[float, float]]):
    clock, arrival_s, last_s = DeviceClock(), 0.0, 0.0
    for step_s, stamp_s in arrival_steps_and_stamps:
        arrival_s += step_s
        time_s = clock.sample_time(arrival_s, stamp_s)
        assert time_s >= last_s
        last_s = time_s


OFFSETS_S: dict[str, list[float]] = {
    "jitter of 3 s": [0.0, 3.0],
    "jitter of 0.5 s": [-0.5, 0.5],
    "saw-tooth of 5 s": [0.1 * n for n in range(50)],
    "two devices 2 s apart": [0.0, 2.0],
    "two devices 1 h apart": [0.0, 3600.0],
    "three devices": [0.0, 4.0, 2.0],
}


@pytest.mark.parametrize("period_s", [0.1, 1.0])
@pytest.mark.parametrize("offsets_s", OFFSETS_S.values(), ids=OFFSETS_S)
def test_jumping_timestamps_do_not_make_the_time_run_fast(offsets_s: list[float], period_s: float):
    clock, arrivals_s = DeviceClock(), [period_s * n for n in range(6000)]
    times_s = [clock.sample_time(s, s + offset_s) for s, offset_s in zip(arrivals_s, itertools.cycle(offsets_s))]
    assert times_s[-1] - times_s[600] == pytest.approx(arrivals_s[-1] - arrivals_s[600], abs=MAX_LEAD_S)
    assert times_s[-1] == pytest.approx(arrivals_s[-1], abs=2.0 * MAX_LEAD_S)


@given(
    steps_s=st.lists(st.sampled_from([0.0, 0.02, 0.1, 1.0, 12.0, 60.0, 4000.0]), min_size=1, max_size=20),
    offsets_s=st.lists(st.floats(-10.0, 10.0) | st.sampled_from([nan, 3600.0, -1e9]), min_size=1, max_size=40),
    rate=st.sampled_from([0.0, 0.5, 0.97, 1.0, 1.0003, 1.04, 2.0, 1000.0]),
)
def test_no_timestamps_make_the_time_lead_the_arrivals_by_more_than_a_constant(
    steps_s: list[float], offsets_s: list[float], rate: float
):
    clock, arrival_s, start_lead_s = DeviceClock(), 0.0, 0.0
    for step_s, offset_s in itertools.islice(zip(itertools.cycle(steps_s), itertools.cycle(offsets_s)), 500):
        lead_s = clock.sample_time(arrival_s, rate * arrival_s + offset_s) - arrival_s
        assert lead_s <= start_lead_s + MAX_LEAD_S + 1e-6
        if arrival_s <= MAX_FIRST_BACKLOG_S:  # a backlog that is being sent at the first sample
            start_lead_s = max(start_lead_s, lead_s)
        arrival_s += step_s


def test_a_clock_that_is_set_in_a_backlog_leaves_the_samples_their_own_times():
    clock = DeviceClock()
    arrivals_s = [s if s < 200 or s > 500 else 501 for s in range(1000)]
    times_s = [clock.sample_time(float(a), s - (3600.0 if s > 300 else 0.0)) for s, a in enumerate(arrivals_s)]
    assert [b - a for a, b in itertools.pairwise(times_s)] == [float(s != 300) for s in range(999)]
    assert (clock.jumps, clock.fault) == (1, "")


def test_timestamp_of_a_text_line_gives_the_sample_time():
    decoder = TextProtocol()
    times_s = [
        decoder.feed(arrival_s, b'{"voltage":1,"current":0,"time_s":%.1f}\n' % stamp_s)["time_s"][0]
        for arrival_s, stamp_s in [(1, 5), (9, 6.5)]
    ]
    assert times_s == [0.0, 1.5]
