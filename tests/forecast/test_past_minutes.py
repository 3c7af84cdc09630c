"""Loads of earlier discharges that were like the present one."""

import numpy as np
import pytest

from bms_estimator.forecast.load_history import MINUTE_S, PEAK_S, LoadHistory, PastMinutes
from bms_estimator.forecast.projection import MAX_STEPS, analogue_parts
from bms_estimator.forecast.trip import GivenLoad
from bms_estimator.kernels.forecast.projected_pack import PROJECTED_PACK
from bms_estimator.kernels.records import TRACE

CAPACITY_AS = 3.0 * 3600.0
MINUTES = 60
"""Duration of a drive [min]."""


def route(seed: int) -> np.ndarray:
    """Return the current of each second of a drive [A]."""
    levels = np.random.default_rng(seed).uniform(0.5, 4.0, MINUTES)
    return np.repeat(levels, MINUTE_S)


def after_drives(*drives: np.ndarray) -> tuple[PastMinutes, LoadHistory]:
    """Return the minutes after drives, with a charge between two of them."""
    load, past, time_s = LoadHistory(CAPACITY_AS), PastMinutes(), 0
    for number, drive in enumerate(drives):
        charge = np.full(3600 if number else 0, -2.0)
        for current_a in np.split(np.concatenate([charge, drive]), np.arange(300, charge.size + drive.size, 300)):
            rows = np.zeros(current_a.size, TRACE)
            rows["time_s"], rows["current_a"] = time_s + np.arange(current_a.size), current_a
            load.add(rows)
            past.add(load)
            time_s += current_a.size
    return past, load


def test_analogue_is_the_load_that_followed_a_similar_one() -> None:
    drive = route(1)
    past, load = after_drives(drive, route(2), drive[: 25 * MINUTE_S])
    [analogue, *_] = past.analogues(load.seconds // MINUTE_S)
    means = np.add.reduceat(analogue.current_a * analogue.duration_s, np.arange(0, analogue.current_a.size, 2))
    assert means[:30] / MINUTE_S == pytest.approx(drive.reshape(-1, MINUTE_S).mean(axis=1)[25:55], rel=0.3)
    assert analogue.duration_s[:2].tolist() == [MINUTE_S - PEAK_S, PEAK_S]


def test_other_routes_have_no_analogue() -> None:
    past, load = after_drives(route(1), route(2), route(3)[: 25 * MINUTE_S])
    assert past.analogues(load.seconds // MINUTE_S) == []


def test_present_discharge_is_no_analogue_of_itself() -> None:
    drive = route(1)
    past, load = after_drives(np.concatenate([drive, drive, drive[: 25 * MINUTE_S]]))
    assert past.analogues(load.seconds // MINUTE_S) == []


def test_too_short_a_load_has_no_analogue() -> None:
    drive = route(1)
    past, load = after_drives(drive, drive[: 10 * MINUTE_S])
    assert past.analogues(load.seconds // MINUTE_S) == []


def test_an_analogue_of_months_is_followed_in_few_parts_that_keep_mean_and_peak_until_the_horizon() -> None:
    minutes, horizon_s = 20_000, 180_000.0
    duration_s, current_a = np.tile([MINUTE_S - PEAK_S, PEAK_S], minutes), np.tile([8.0, 40.0], minutes)
    load = GivenLoad(duration_s, current_a, np.full(2 * minutes, np.nan))
    [(_, parts)] = analogue_parts(np.zeros(1, PROJECTED_PACK), [load], horizon_s)
    assert parts.size <= 4 * MAX_STEPS
    assert horizon_s <= parts["duration_s"].sum() <= horizon_s + 2 * horizon_s / MAX_STEPS
    mean_a = np.average(parts["current_a"], weights=parts["duration_s"])
    assert mean_a == pytest.approx(np.average(current_a, weights=duration_s), rel=1e-9)
    assert parts["current_a"].max() == 40.0
