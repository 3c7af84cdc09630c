"""Hysteresis of the decision whether the SOC is known."""

import math

import numpy as np
import pytest

from bms_estimator.kernels.accumulators.publish_window import known_rows
from bms_estimator.kernels.records import TRACE


@pytest.mark.parametrize(
    ("stds", "known"),
    [
        ([0.3, 0.14, 0.12, 0.119, 0.14, 0.15, 0.151, 0.14, 0.1], [0, 0, 0, 1, 1, 1, 0, 0, 1]),
        ([0.14, 0.13], [0, 0]),  # between the limits at the start
        ([math.nan, math.nan], [1, 1]),  # coulomb counting alone
    ],
)
def test_soc_is_known_below_12_percent_until_above_15_percent(stds: list[float], known: list[int]) -> None:
    trace = np.zeros(len(stds), TRACE)
    trace["soc_std"] = stds
    assert known_rows(trace, False).tolist() == known
    was_known, one_by_one = False, []
    for i in range(trace.size):
        was_known = bool(known_rows(trace[i : i + 1], was_known)[-1])
        one_by_one.append(was_known)
    assert one_by_one == known
