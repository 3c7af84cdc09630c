"""Sample clock: it never steps back, however the source's clock and the host's clocks behave."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.edge.sample_clock import DEAD_BAND_S, GRID, SLEW, STEP_S, WINDOW_S, SampleClock

WALL_S = 1.7e9
"""Wall clock at the start [s since 1970]."""


def place_each(
    clock: SampleClock, source_s: np.ndarray, delay_s: float | np.ndarray = 0.0, host_s: np.ndarray | None = None
) -> np.ndarray:
    """Place samples one by one and return their times.

    Each sample arrives ``delay_s`` after ``host_s`` (by default its time by the source's clock). Wall and steady clock
    run alike.
    """
    arrival_s = np.broadcast_to((source_s if host_s is None else host_s) + delay_s, source_s.shape)
    return np.concatenate(
        [
            clock.place(np.array([time_s]), wall_s=WALL_S + now_s, steady_s=now_s)
            for time_s, now_s in zip(source_s, arrival_s, strict=True)
        ]
    )


def test_constant_source_period_stays_exactly_constant_despite_varying_delays() -> None:
    source_s = 0.37 + np.arange(3600.0)
    delay_s = np.random.default_rng(1).uniform(0.0, 0.3, source_s.size)
    placed = place_each(SampleClock(), source_s, delay_s)
    assert set(np.diff(placed)) == {1.0}
    assert placed[0] == pytest.approx(WALL_S + source_s[0] + delay_s[0], abs=2 / GRID)


@pytest.mark.parametrize("drift", [-0.008, -0.0005, 0.0005, 0.008])
def test_drifting_source_clock_is_corrected_without_a_gap(drift: float) -> None:
    host_s = np.arange(0.0, 40_000.0, 10.0)
    source_s = host_s * (1.0 + drift)
    clock = SampleClock()
    placed = place_each(clock, source_s, host_s=host_s)
    assert clock.steps == 1  # the start
    assert np.abs(placed - WALL_S - host_s).max() < DEAD_BAND_S + 2.0 * SLEW * WINDOW_S
    assert np.abs(placed[-1] - WALL_S - host_s[-1]) < STEP_S
    assert np.diff(placed).max() <= 10.0 * (1.0 + 2.0 * SLEW)
    assert np.diff(placed).min() >= 10.0 * (1.0 - 2.0 * SLEW)


def test_time_follows_the_host_if_the_source_clock_runs_at_half_speed() -> None:
    host_s = np.arange(0.0, 20_000.0, 10.0)
    placed = place_each(SampleClock(), 0.5 * host_s, host_s=host_s)
    assert WALL_S + host_s[-1] - placed[-1] <= WINDOW_S


def test_samples_of_a_restarted_source_continue_by_the_host_clock() -> None:
    clock = SampleClock()
    before = place_each(clock, np.arange(100.0))
    after = place_each(clock, np.arange(100.0), host_s=np.arange(1000.0, 1100.0))
    assert clock.steps == 2  # the start and the restart
    assert after[0] - before[-1] == pytest.approx(901.0)  # from 99 s to 1000 s by the host's clock


def test_samples_continue_at_the_source_period_after_an_advance_to_a_later_time() -> None:
    clock = SampleClock()
    place_each(clock, np.arange(10.0))
    clock.advance_to(WALL_S)  # an earlier time has no effect
    assert place_each(clock, np.arange(10.0, 20.0))[-1] == WALL_S + 19.0
    clock.advance_to(WALL_S + 1e8)
    assert (place_each(clock, np.arange(20.0, 30.0)) == WALL_S + 1e8 + np.arange(10.0)).all()


def test_step_back_within_one_read_is_detected() -> None:
    clock = SampleClock()
    clock.place(np.array([0.0]), WALL_S, 0.0)
    placed = clock.place(np.array([1.0, 2.0, 0.0, 1.0]), WALL_S + 3.0, 3.0)
    assert clock.steps == 2
    assert (np.diff(placed) >= 0.0).all()


def test_source_clock_that_jumps_ahead_is_ignored() -> None:
    clock = SampleClock()
    place_each(clock, np.arange(10.0))
    placed = clock.place(np.array([1e6]), WALL_S + 10.0, 10.0)
    assert placed[0] == pytest.approx(WALL_S + 10.0)


def test_samples_that_arrive_late_keep_the_times_of_the_source() -> None:
    source_s = np.arange(2000.0)
    host_s = np.where((source_s > 10.0) & (source_s < 900.0), 900.0, source_s)  # samples from 11 s on arrive at 900 s
    placed = place_each(SampleClock(), source_s, host_s=host_s)
    assert set(np.diff(placed)) == {1.0}


def test_wall_clock_set_ahead_leaves_a_gap_and_wall_clock_set_back_is_ignored() -> None:
    clock = SampleClock()
    source_s = np.arange(3.0)
    first = clock.place(source_s, WALL_S, 0.0)
    back = clock.place(source_s + 3.0, WALL_S - 5000.0, 3.0)
    ahead = clock.place(source_s + 6.0, WALL_S + 36_000.0, 6.0)
    assert back[0] - first[-1] == 1.0
    # the last of three samples is placed at now, the first one 2 s earlier; back[-1] was placed at WALL_S + 3 s
    assert ahead[0] - back[-1] == pytest.approx(36_000.0 - 3.0 - 2.0)


def test_restarted_clock_leaves_a_gap_and_does_not_step_back() -> None:
    last_s = place_each(SampleClock(), np.arange(10.0))[-1]
    later = SampleClock(last_s).place(np.arange(3.0), wall_s=WALL_S + 500.0, steady_s=7.0)
    assert later[-1] == pytest.approx(WALL_S + 500.0)
    set_back = SampleClock(last_s).place(np.arange(3.0), wall_s=WALL_S - 9e8, steady_s=7.0)
    assert set_back[0] >= last_s
    assert set_back[-1] == pytest.approx(last_s + 2.0)


@given(
    st.lists(
        st.tuples(
            st.lists(st.floats(-1e9, 1e9) | st.just(math.nan) | st.just(math.inf), min_size=1, max_size=5),
            st.floats(0.0, 4e9),
            st.floats(0.0, 1e7),
        ),
        max_size=30,
    )
)
def test_time_never_steps_back(reads: list[tuple[list[float], float, float]]) -> None:
    clock, steady_s, last_s = SampleClock(), 0.0, -math.inf
    for source_s, wall_s, elapsed_s in reads:  # elapsed_s since the previous read
        steady_s += elapsed_s
        placed = clock.place(np.array(source_s), wall_s, steady_s)
        assert placed.shape == (len(source_s),)
        assert np.isfinite(placed).all()
        assert (np.diff(placed, prepend=last_s) >= 0.0).all()
        last_s = placed[-1]
