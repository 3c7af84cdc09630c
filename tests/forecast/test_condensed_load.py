"""Condensed loads keep duration, mean and peaks."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bms_estimator.forecast.projection import condense
from bms_estimator.forecast.trip import GivenLoad


def power_load(duration_s: list[float], power_w: list[float]) -> GivenLoad:
    return GivenLoad(np.array(duration_s), np.full(len(duration_s), np.nan), np.array(power_w))


PARTS = st.lists(st.tuples(st.floats(0.1, 30.0), st.floats(-500.0, 500.0)), min_size=1, max_size=60)


@given(parts=PARTS, block_s=st.floats(1.0, 100.0))
def test_duration_energy_and_peak_remain(parts: list[tuple[float, float]], block_s: float) -> None:
    load = power_load(*map(list, zip(*parts, strict=True)))
    condensed = condense(load, block_s)
    assert condensed.duration_s.sum() == pytest.approx(load.duration_s.sum())
    energy_ws, condensed_ws = load.power_w @ load.duration_s, condensed.power_w @ condensed.duration_s
    assert condensed_ws == pytest.approx(energy_ws, rel=1e-6, abs=1e-6 * 500.0 * load.duration_s.sum())
    assert condensed.power_w.max() == pytest.approx(load.power_w.max(), rel=1e-12)
    assert condensed.duration_s.size <= 2 * np.ceil(load.duration_s.sum() / block_s)
    assert np.isnan(condensed.current_a).all()


def test_parts_longer_than_a_block_are_unchanged() -> None:
    load = power_load([60.0, 5.0, 60.0], [1.0, 100.0, 2.0])
    condensed = condense(load, 4.0)
    assert condensed.duration_s.tolist() == load.duration_s.tolist()
    assert condensed.power_w.tolist() == load.power_w.tolist()


def test_short_parts_become_their_mean_and_their_peak() -> None:
    load = GivenLoad(np.full(4, 0.25), np.array([1.0, 9.0, 2.0, 3.0]), np.full(4, np.nan))
    condensed = condense(load, 1.0)
    assert condensed.duration_s.tolist() == [0.75, 0.25]
    assert condensed.current_a.tolist() == [2.0, 9.0]
