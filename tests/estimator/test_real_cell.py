"""Estimator on captures of a Nissan Leaf cell, with a wrong initial SOC.

The captures start full, so that the true SOC is counted.
"""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator, estimate
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.columns import Columns
from bms_estimator.sources.captures.replay import load_capture
from tests.estimator.anywhere.run import run_of
from tests.estimator.anywhere.score import score
from tests.estimator.simulated_cell import run_divided


def discharged_fraction(samples: SampleBlock, cell: CellModel) -> np.ndarray:
    """Return the charge drawn before each sample, as a fraction of the capacity."""
    charge_as = np.r_[0.0, np.cumsum(samples["current_a"][:-1] * np.diff(samples["time_s"]))]
    return charge_as / (3600.0 * cell.cell.capacity_ah)


@pytest.mark.parametrize("first", [0, 3000, 6000], ids=["from full", "under 10 A", "half way"])
def test_an_initial_soc_wrong_by_0_2_is_corrected_within_an_hour(data, first):
    cell, samples = load_cell("leaf"), load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz").rows
    soc = 1.0 - discharged_fraction(samples, cell)[first:]
    trace = estimate(Columns(samples[first:]), cell, initial_soc=soc[0] - 0.2)
    compared = (trace["time_s"] > trace["time_s"][0] + 3600.0) & (soc > 0.05)
    error = trace["soc"][compared] - soc[compared]
    assert np.abs(error).max() < 0.02
    assert (np.abs(error) < 2.0 * trace["soc_std"][compared]).mean() > 0.95


@pytest.mark.parametrize("soc_error", [-0.2, 0.2])
def test_nees_and_nis_in_mid_load_match_the_std(data, soc_error):
    """The estimator starts after 35 % of the discharge.

    The first 15 min are not scored. Coverage and std are in percent.
    """
    cell, samples = load_cell("leaf"), load_capture(data / "leaf" / "hppc_25c_from_full.csv.gz").rows
    discharged = discharged_fraction(samples, cell)
    soc, first = 1.0 - discharged, int(np.argmax(discharged >= 0.35 * discharged[-1]))
    run = run_of(Estimator(cell, initial_soc=soc[first] + soc_error), samples[first:])
    result = score(samples["time_s"][first:], run.soc, run.soc_std, soc[first:])
    assert 0.3 < run.nis(after_s=900.0) < 2.0
    assert result.cover > 95.0
    assert result.std < 1.5
    assert result.nees < 2.0


def test_run_and_step_give_bit_identical_states_on_a_real_capture(data):
    cell, capture = load_cell("leaf"), load_capture(data / "leaf" / "cc_1c.csv.gz")
    run_divided(lambda: Estimator(cell), capture.rows)
