"""Estimator on a real capture with a wrong initial SOC."""

import numpy as np
import pytest

from bms_estimator import Estimator, estimate, load_capture, load_cell
from bms_estimator.model.columns import Columns
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import score


@pytest.mark.parametrize("first", [0, 3000, 6000], ids=["from full", "under 10 A", "mid way"])
def test_an_initial_soc_wrong_by_0_2_is_corrected_within_an_hour(data, first):
    """Nissan Leaf with its cell file. The true SOC is counted from full."""
    cell, whole = load_cell("leaf"), load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz")
    drawn_as = np.r_[0.0, np.cumsum(whole["current_a"][:-1] * np.diff(whole["time_s"]))]
    soc = (1.0 - drawn_as / (3600.0 * cell.cell.capacity_ah))[first:]
    found = estimate(Columns(whole.rows[first:]), cell, initial_soc=soc[0] - 0.2)
    judged = (found["time_s"] > found["time_s"][0] + 3600.0) & (soc > 0.05)
    error = found["soc"][judged] - soc[judged]
    assert np.abs(error).max() < 0.02
    assert (np.abs(error) < 2.0 * found["soc_std"][judged]).mean() > 0.95


@pytest.mark.parametrize("wrong", [-0.2, 0.2])
def test_nees_and_nis_in_mid_load_match_the_std(data, wrong):
    """Nissan Leaf from 35 % of its charge on: NIS of ten minutes, NEES, and a limit of the std."""
    cell, samples = load_cell("leaf"), load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz").rows
    drawn_as = np.r_[0.0, np.cumsum(samples["current_a"][:-1] * np.diff(samples["time_s"]))]
    soc, first = 1.0 - drawn_as / (3600.0 * cell.cell.capacity_ah), int(np.argmax(drawn_as >= 0.35 * drawn_as[-1]))
    run = run_of(Estimator(cell, initial_soc=soc[first] + wrong), samples[first:])
    found = score(samples["time_s"][first:], run.soc, run.soc_std, soc[first:])
    assert 0.3 < run.nis(900.0) < 2.0
    assert found.cover > 95.0
    assert found.std < 1.5
    assert found.nees < 2.0


def test_blocks_of_a_real_capture_give_exactly_the_state_of_single_samples(data):
    cell, capture = load_cell("leaf"), load_capture(data / "leaf" / "cc_1c.csv.gz")
    whole, stepped = Estimator(cell), Estimator(cell)
    whole.run(capture.rows)
    for sample in capture.rows:
        stepped.step(sample["time_s"], sample["current_a"], sample["voltage_v"])
    assert whole.record.tobytes() == stepped.record.tobytes()
