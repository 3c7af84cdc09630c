"""LFP cells, whose voltage hardly depends on the SOC until the end of the plateau."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import Sampling
from tests.estimator.simulated_cell import simulate_file

CAPACITY_AH = 2.3


@pytest.mark.parametrize(("rate_c", "initial_soc"), [(0.1, None), (0.1, 0.5), (0.25, None), (0.5, 0.5)])
def test_the_true_soc_stays_inside_the_interval_until_the_end_of_a_charge_at_constant_current(
    rate_c: float, initial_soc: float | None
) -> None:
    """The voltage of the plateau gives no information. The rise at its end shows the SOC."""
    cell = load_cell("lfp", CAPACITY_AH)
    current_a = np.r_[np.zeros(60), np.full(int(0.2 / rate_c * 3600), -rate_c * CAPACITY_AH)]
    samples, true_soc = simulate_file(cell, current_a, 0.8)
    sampling = Sampling(5.0, voltage_gain_std=0.005, current_gain_std=0.005)
    trace = Estimator(cell, initial_soc=initial_soc, sampling=sampling).run(samples[::5])
    after_start = trace["time_s"] > 900.0
    error = (trace["soc"] - true_soc[::5])[after_start]
    assert (np.abs(error) < 2.0 * trace["soc_std"][after_start]).all()
    assert abs(error[-1]) < 0.02
