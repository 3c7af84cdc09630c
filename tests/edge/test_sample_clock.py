"""Sample clock: it never steps back, for any behaviour of the other clocks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bms_estimator.edge.sample_clock import DEAD_BAND_S, GRID, STEP_S, SampleClock

WALL_S = 1.7e9
"""Wall clock at the start [s since 1970]."""


def run(clock: SampleClock, source_s: np.ndarray, delay_s: float | np.ndarray = 0.0, host_s: np.ndarray | None = None):
    """Place samples one by one at ``host_s`` (default: their own times), with equal wall and steady clocks."""
    host_s = (source_s if host_s is None else host_s) + delay_s
    host_s = np.broadcast_to(host_s, source_s.shape)
    return np.concatenate([clock.place(np.array([t]), WALL_S + h, h) for t, h in zip(source_s, host_s, strict=True)])


def test_constant_period_stays_exactly_constant() -> None:
    source_s = 0.37 + np.arange(3600.0)
    delay_s = np.random.default_rng(1).uniform(0.0, 0.3, source_s.size)
    placed = run(SampleClock(), source_s, delay_s)
    assert set(np.diff(placed)) == {1.0}
    assert placed[0] == pytest.approx(WALL_S + source_s[0] + delay_s[0], abs=2 / GRID)


@pytest.mark.parametrize("drift", [-0.008, -0.0005, 0.0005, 0.008])
def test_drifting_source_clock_is_corrected_without_a_gap(drift: float) -> None:
    host_s = np.arange(0.0, 40_000.0, 10.0)
    source_s = host_s * (1.0 + drift)
    clock = SampleClock()
    placed = run(clock, source_s, host_s=host_s)
    assert clock.steps == 1  # the start
    assert np.abs(placed - WALL_S - host_s).max() < DEAD_BAND_S + 0.02 * 600.0
    assert np.abs(placed[-1] - WALL_S - host_s[-1]) < STEP_S
    assert np.diff(placed).max() <= 10.0 * 1.02
    assert np.diff(placed).min() >= 10.0 * 0.98


def test_time_advances_with_a_source_clock_of_half_speed() -> None:
    host_s = np.arange(0.0, 20_000.0, 10.0)
    placed = run(SampleClock(), 0.5 * host_s, host_s=host_s)
    assert WALL_S + host_s[-1] - placed[-1] <= 600.0


def test_restarted_source_continues_by_the_host_clock() -> None:
    clock = SampleClock()
    before = run(clock, np.arange(100.0))
    after = run(clock, np.arange(100.0), host_s=np.arange(1000.0, 1100.0))
    assert clock.steps == 2
    assert after[0] - before[-1] == pytest.approx(901.0)


def test_advance_to_a_later_time_keeps_the_source_period() -> None:
    clock = SampleClock()
    run(clock, np.arange(10.0))
    clock.advance_to(WALL_S)  # an earlier time has no effect
    assert run(clock, np.arange(10.0, 20.0))[-1] == WALL_S + 19.0
    clock.advance_to(WALL_S + 1e8)
    assert (run(clock, np.arange(20.0, 30.0)) == WALL_S + 1e8 + np.arange(10.0)).all()


def test_step_back_within_one_read_is_detected() -> None:
    clock = SampleClock()
    clock.place(np.array([0.0]), WALL_S, 0.0)
    placed = clock.place(np.array([1.0, 2.0, 0.0, 1.0]), WALL_S + 3.0, 3.0)
    assert clock.steps == 2
    assert (np.diff(placed) >= 0.0).all()


def test_source_clock_that_jumps_ahead_is_ignored() -> None:
    clock = SampleClock()
    run(clock, np.arange(10.0))
    placed = clock.place(np.array([1e6]), WALL_S + 10.0, 10.0)
    assert placed[0] == pytest.approx(WALL_S + 10.0)


def test_delayed_samples_keep_their_own_times() -> None:
    clock = SampleClock()
    placed = run(clock, np.arange(2000.0), host_s=np.maximum(np.arange(2000.0), 900.0 * (np.arange(2000.0) > 10.0)))
    assert set(np.diff(placed)) == {1.0}


def test_wall_clock_set_ahead_is_a_gap_and_set_back_is_ignored() -> None:
    clock = SampleClock()
    source_s = np.arange(3.0)
    first = clock.place(source_s, WALL_S, 0.0)
    back = clock.place(source_s + 3.0, WALL_S - 5000.0, 3.0)
    ahead = clock.place(source_s + 6.0, WALL_S + 36_000.0, 6.0)
    assert back[0] - first[-1] == 1.0
    assert ahead[0] - back[-1] == pytest.approx(36_000.0 - 3.0 - 2.0)


def test_restart_is_a_gap_and_never_steps_back() -> None:
    last_s = run(SampleClock(), np.arange(10.0))[-1]
    assert SampleClock(last_s).place(np.arange(3.0), WALL_S + 500.0, 7.0)[-1] == pytest.approx(WALL_S + 500.0)
    set_back = SampleClock(last_s).place(np.arange(3.0), WALL_S - 9e8, 7.0)
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
    for source_s, wall_s, elapsed_s in reads:
        steady_s += elapsed_s
        placed = clock.place(np.array(source_s), wall_s, steady_s)
        assert placed.shape == (len(source_s),)
        assert np.isfinite(placed).all()
        assert (np.diff(placed, prepend=last_s) >= 0.0).all()
        last_s = placed[-1]
