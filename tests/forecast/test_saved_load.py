"""Observed load, saved and restored."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bms_estimator.forecast.load_history import LoadHistory, PastMinutes, load_arrays, restore_load
from bms_estimator.kernels.forecast.load_seconds import MAX_LOAD_S
from bms_estimator.kernels.records import TRACE

CAPACITY_AS = 3.0 * 3600.0


def observed_load(seconds: int, first_s: float = 0.0) -> LoadHistory:
    load = LoadHistory(CAPACITY_AS)
    load.add(drive(seconds, first_s))
    return load


def drive(seconds: int, first_s: float = 0.0) -> Any:
    """Return rows of a discharge with changing current."""
    rows = np.zeros(seconds, TRACE)
    rows["time_s"] = first_s + np.arange(seconds)
    rows["current_a"] = 1.0 + np.sin(0.1 * rows["time_s"])
    return rows


@pytest.mark.parametrize("seconds", [2, 700, MAX_LOAD_S + 500])
def test_restored_load_continues_like_the_saved_one(seconds: int) -> None:
    load, past, restored, restored_past = observed_load(seconds), PastMinutes(), LoadHistory(CAPACITY_AS), PastMinutes()
    past.add(load)
    restore_load(restored, restored_past, load_arrays(load, past))
    assert restored_past.mean_a == pytest.approx(past.mean_a, rel=1e-6)
    assert restored.seconds == load.seconds
    more = drive(600, 1e6)  # after a gap
    for each in (load, restored):
        each.add(more)
    for one, other in zip(load.mean_and_max(), restored.mean_and_max(), strict=True):
        assert one.tobytes() == other.tobytes()
    assert (restored.is_charging, restored.rest_s) == (load.is_charging, load.rest_s)


currents_a = st.floats(-1000.0, 1000.0, width=32)
steps_s = st.one_of(st.floats(0.001, 5.0), st.sampled_from([0.1, 1.0 / 3.0, 1.0, 5.1, 100.0]))


@settings(max_examples=200)
@given(st.lists(st.tuples(steps_s, currents_a, st.integers(1, 30)), min_size=1, max_size=80))
def test_every_load_is_restored_as_saved(load_parts: list[tuple[float, float, int]]) -> None:
    step_s, current_a, repeats = (np.array(column) for column in zip(*load_parts, strict=True))
    rows = np.zeros(repeats.sum(), TRACE)
    rows["time_s"], rows["current_a"] = np.cumsum(np.repeat(step_s, repeats)), np.repeat(current_a, repeats)
    load, past, restored, restored_past = LoadHistory(1e5), PastMinutes(), LoadHistory(1e5), PastMinutes()
    load.add(rows)
    past.add(load)
    arrays = load_arrays(load, past)
    restore_load(restored, restored_past, arrays)
    again = load_arrays(restored, restored_past)
    assert {name: array.tobytes() for name, array in again.items()} == {name: a.tobytes() for name, a in arrays.items()}


def test_largest_current_of_a_second_is_never_below_its_mean() -> None:
    rows = np.zeros(50_000, TRACE)
    rng = np.random.default_rng(1)
    rows["time_s"] = np.cumsum(rng.choice([0.1, 0.3, 1.0, 5.1], rows.size))
    rows["current_a"] = rng.choice([0.1, 18.0, 0.7, 40.0], rows.size)
    load = LoadHistory(1e6)
    load.add(rows)
    mean_a, max_a = load.mean_and_max()
    assert (mean_a <= max_a).all()


def test_load_of_an_earlier_version_with_too_small_largest_currents_is_restored() -> None:
    load, past = LoadHistory(CAPACITY_AS), PastMinutes()
    arrays = load_arrays(observed_load(400), past)
    arrays["max_a"][7] = 0.5 * arrays["mean_a"][7]
    restore_load(load, past, arrays)
    assert load.max_a[7] == load.mean_a[7]


def test_largest_currents_survive_a_charge_and_a_restart() -> None:
    load, past, restored = observed_load(400), PastMinutes(), LoadHistory(CAPACITY_AS)
    charge = drive(2000, 400.0)
    charge["current_a"] = -1.2
    load.add(charge)
    assert load.seconds == 0
    restore_load(restored, PastMinutes(), load_arrays(load, past))
    assert restored.seen_a == load.seen_a == pytest.approx((2.0, 1.2), rel=0.01)


def test_load_of_an_earlier_version_without_largest_currents_is_restored() -> None:
    load, past, arrays = LoadHistory(CAPACITY_AS), PastMinutes(), load_arrays(observed_load(400), PastMinutes())
    del arrays["seen_discharge_a"], arrays["seen_charge_a"]
    restore_load(load, past, arrays)
    assert load.seconds > 390
    assert load.seen_a == (0.0, 0.0)


def test_load_is_restored_after_a_rest_of_a_year() -> None:
    load, past = LoadHistory(CAPACITY_AS), PastMinutes()
    restore_load(load, past, load_arrays(observed_load(400), past) | {"rest_s": np.array(365 * 86_400)})
    assert load.rest_s == 365 * 86_400


@pytest.mark.parametrize(
    "damage",
    [
        lambda arrays: arrays.pop("max_a"),
        lambda arrays: arrays.update(mean_a=np.full(3, np.nan), max_a=np.full(3, np.nan)),
        lambda arrays: arrays.update(mean_a=np.full(3, 1e9), max_a=np.full(3, 1e9)),
        lambda arrays: arrays.update(mean_a=np.ones(MAX_LOAD_S + 1), max_a=np.ones(MAX_LOAD_S + 1)),
        lambda arrays: arrays.update(mean_a=np.ones(4)),
        lambda arrays: arrays.update(mean_a=np.ones((2, 2)), max_a=np.ones((2, 2))),
        lambda arrays: arrays.update(rest_s=np.array(-1)),
        lambda arrays: arrays.update(minutes_mean_a=np.full(3, np.inf), minutes_max_a=np.full(3, np.inf)),
        lambda arrays: arrays.update(minutes_mean_a=np.ones(3)),
        lambda arrays: arrays.update(rest_s=np.zeros(2)),
        lambda arrays: arrays.update(filtered_a=np.array("x")),
    ],
)
def test_damaged_arrays_are_rejected_and_change_nothing(damage: Callable[[dict[str, Any]], object]) -> None:
    arrays, load, past = load_arrays(observed_load(400), PastMinutes()), LoadHistory(CAPACITY_AS), PastMinutes()
    damage(arrays)
    empty = load.record.tobytes()
    with pytest.raises(ValueError, match=r"missing|must be equal|not finite|is negative"):
        restore_load(load, past, arrays)
    assert load.record.tobytes() == empty
