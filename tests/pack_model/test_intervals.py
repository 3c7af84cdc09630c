"""Tests of the links between intervals of the history."""

import numpy as np
import pytest

from bms_estimator.pack_model.intervals import DAILY_STD_SOC, Intervals, Links
from tests.pack_model.histories import cell_curves, measured_rows

COUNTED_STD = 0.01
"""Std of the charge counted in each of the two segments, as a fraction of the capacity."""


def test_std_of_link_across_gap_contains_charge_before_and_after_it() -> None:
    """The SOC after a gap is counted from the start of the interval before it, with the errors of all charge since."""
    cell = cell_curves()
    before, after = measured_rows(cell, 1), measured_rows(cell, 1, segment=1, gap_s=600.0)
    after["elapsed_s"] += before["elapsed_s"][-1] + 600.0
    before["charge_variance_as2"] = np.linspace(0.0, (COUNTED_STD * cell.capacity_as) ** 2, before.size)
    after["charge_variance_as2"] = (COUNTED_STD * cell.capacity_as) ** 2
    rows = np.concatenate([before, after])
    links = Links.of(cell, Intervals(cell, rows))
    assert links.interval.tolist() == [1]
    throughput_soc = before["throughput_soc"][-1] - before["throughput_soc"][0] + after["throughput_soc"][0]
    days = (after["elapsed_s"][0] - before["elapsed_s"][0]) / 86400.0
    variance = 2.0 * COUNTED_STD**2 + cell.charge_error**2 * throughput_soc + DAILY_STD_SOC**2 * days
    assert links.std[0] ** 2 == pytest.approx(variance, rel=1e-9)
