"""Estimator with generic cell files on cells that were not used for them: LFP of a third make, and NMC."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.base.polled_protocol import BMS_GAIN_STD
from bms_estimator.settings.observer import Sampling
from bms_estimator.sources.captures.replay import load_capture
from tests.estimator.anywhere.score import score


@pytest.mark.parametrize(
    ("name", "chemistry", "capacity_ah", "max_rmse", "min_cover"),
    [
        # The voltage is 53 to 66 mV above the generic curve. The capture begins in the middle of a discharge.
        ("lfp_from_soc_0p64", "lfp", 3.5, 9.0, 80.0),
        ("nmc_1ah", "nmc", 1.0, 5.0, 90.0),
    ],
)
def test_a_cell_of_another_make_is_estimated(
    data: Path, name: str, chemistry: str, capacity_ah: float, max_rmse: float, min_cover: float
) -> None:
    path = data / "pybatteryid" / f"{name}.csv.gz"
    time_s, true_soc = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 4), unpack=True)
    cell, sampling = load_cell(chemistry, capacity_ah), Sampling(period_s=1.0, voltage_gain_std=BMS_GAIN_STD)
    trace = Estimator(cell, sampling=sampling).run(load_capture(path).rows)
    result = score(*(trace[n] for n in ("time_s", "soc", "soc_std")), np.interp(trace["time_s"], time_s, true_soc), 0.0)
    assert result is not None
    assert result.rmse < max_rmse
    assert result.cover > min_cover
