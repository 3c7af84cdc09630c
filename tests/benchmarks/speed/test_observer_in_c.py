"""The observer in C has the results of the kernel, so that the benchmark compares equal work."""

import shutil

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import ObserverSettings
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.speed.observer_in_c import ObserverInC


@pytest.mark.parametrize(
    "settings",
    [ObserverSettings(), ObserverSettings(dead_zone_v=0.0), ObserverSettings(law="scheme-3", nussbaum="k2-cos")],
    ids=["default", "no dead zone", "scheme 3"],
)
def test_the_observer_in_c_gives_the_results_of_the_kernel(settings, tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler (apt install gcc)")
    block = pulses(60_000)
    block["voltage_v"][20_000:20_010] = np.nan  # ten samples that both must drop
    block["current_a"][30_000:30_010:2] += 10.0  # five samples that the voltage contradicts
    block["current_a"][40_000:40_005] += 10.0  # two samples that the third confirms
    estimator, c_estimator = (Estimator(load_cell(CELL), settings, identifier=None) for _ in range(2))
    expected = estimator.run(block)
    trace = np.zeros(block.size, dtype=TRACE)
    rows = ObserverInC(tmp_path).run(c_estimator.record, c_estimator.settings_record, block, trace)
    assert rows == expected.size == block.size - 19
    for name in ("soc", "voltage_estimate_v", "innovation_v", "nussbaum_gain", "k", "delta_1", "delta_2"):
        np.testing.assert_allclose(trace[name][:rows], expected[name], rtol=1e-9, atol=1e-12, err_msg=name)
    assert np.array_equal(trace["lock"][:rows], expected["lock"])
    for name in ("dropped_not_finite", "dropped_contradicted", "samples"):
        assert c_estimator.state[name][0] == estimator.state[name][0], name
