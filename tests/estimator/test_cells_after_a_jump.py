"""Estimator of the single cells after a far jump of the samples' clock."""

import numpy as np
import pytest

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from tests.forecast.simulated_load import changing_load

CELLS = 4


@pytest.mark.parametrize("jump_s", [1.7e18, 1e29])
def test_a_state_after_a_far_jump_of_the_clock_can_be_restored(jump_s: float) -> None:
    pack = load_cell("chen_mora").pack(CELLS, 1)
    samples, rng = changing_load(600), np.random.default_rng(0)
    cells_v = samples["voltage_v"][:, np.newaxis] + 0.002 * rng.standard_normal((samples.size, CELLS))
    samples["voltage_v"] = cells_v.sum(axis=1)
    samples["time_s"][300:] += jump_s
    estimator = Estimator(pack, initial_soc=0.9)
    cells = CellEstimator(estimator)
    for start in range(0, samples.size, 100):
        block = slice(start, start + 100)
        cells.run(samples[block], cells_v[block], estimator.run(samples[block]))
    assert cells.deviations
    assert CellEstimator(estimator).restore(cells.saved_state, 0.0) == ""
