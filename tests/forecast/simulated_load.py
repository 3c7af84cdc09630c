"""Simulated cell under a changing load, and a forecaster of it."""

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.pack.pack import Pack
from tests.estimator.simulated_cell import TRUTH, measured

CUTOFF_V = 3.0
LEVELS_A = (0.0, 0.8, 1.5, 3.0, -0.3)
"""Currents of the load. Their mean is 1 A, a third of the cell's capacity in an hour."""
LEVEL_S = 20
"""Duration of each current level [s]."""


def changing_load(seconds: int, soc: float = 0.9, seed: int = 1) -> SampleBlock:
    """Return samples at 1 Hz of the cell under a load with random levels."""
    rng = np.random.default_rng(seed)
    levels_a = rng.choice(LEVELS_A, seconds // LEVEL_S + 1)
    return measured(np.repeat(levels_a, LEVEL_S)[:seconds], soc, rng)[0]


def constant_load(current_a: float, seconds: int, soc: float = 0.9) -> SampleBlock:
    """Return samples at 1 Hz of the cell under a constant current [A]."""
    return measured(np.full(seconds, current_a), soc, np.random.default_rng(1))[0]


def forecasting_pack(soc: float = 0.9, cutoff_v: float = CUTOFF_V) -> Pack:
    """Return a pack with forecasts whose estimator starts at ``soc``."""
    estimator = Estimator(TRUTH, initial_soc=soc)
    return Pack(estimator, forecaster=Forecaster(estimator, cutoff_v=cutoff_v))


def cutoff_s(block: SampleBlock, cutoff_v: float = CUTOFF_V) -> float:
    """Return the time of the first sample at or below the cut-off voltage [s]."""
    below = block["voltage_v"] <= cutoff_v
    assert below.any()
    return float(block["time_s"][below.argmax()])
