"""Coverage estimated in hindsight, compared with the true coverage of a real capture."""

import numpy as np
import pytest

from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.captures.replay import load_capture
from tests.benchmarks.fleet.hindsight import limits, normalized_errors, slots

SLOT_S = 60.0
"""Duration of a slot of a capture, which stands for an hour of a fleet [s]."""


@pytest.fixture(scope="module")
def packs(data):
    """Return estimates of a Nissan Leaf. They begin at four samples, each with initial SOC errors of 0.2 and -0.2.

    The true SOC is counted from the full battery.
    """
    cell, capture = load_cell("leaf"), load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz")
    discharged_as = np.r_[0.0, np.cumsum(capture["current_a"][:-1] * np.diff(capture["time_s"]))]
    soc = 1.0 - discharged_as / (3600.0 * cell.cell.capacity_ah)
    starts = [(first, soc_error) for first in (0, 2000, 4000, 6000) for soc_error in (-0.2, 0.2)]
    return [
        slots(
            f"p{n}", cell, capture.rows[first:], soc[first:], float(np.clip(soc[first] + soc_error, 0.0, 1.0)), SLOT_S
        )
        for n, (first, soc_error) in enumerate(starts)
    ]


def test_coverage_estimated_in_hindsight_agrees_with_the_true_coverage(packs, tmp_path):
    write(tmp_path, [slot.hour for pack in packs for slot in pack])
    (overall, *_) = run_query(tmp_path, "honest", limits=limits(SLOT_S)).records
    errors_in_stds = [error for pack in packs for error in normalized_errors(pack)]
    is_inside = np.abs(errors_in_stds) <= 2.0
    assert overall["packs"] == len(packs)
    assert overall["within_2_std"] == pytest.approx(is_inside.mean(), abs=0.1)
    assert overall["low"] > 0.5


def test_too_narrow_band_is_detected(packs, tmp_path):
    narrow = [
        slot.hour.model_copy(update={"soc_mean_std": (slot.hour.soc_mean_std or 0.0) / 8.0})
        for pack in packs
        for slot in pack
    ]
    write(tmp_path, narrow)
    assert run_query(tmp_path, "honest", limits=limits(SLOT_S)).records[0]["within_2_std"] < 0.6
