"""Captures of a simulated cell, for the tests of identification."""

import numpy as np

from bms_estimator.calibration.elements import SIZE
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import ocv, simulate_cell
from bms_estimator.model.cell import ELEMENTS, CellModel, load_cell
from bms_estimator.model.sample import SAMPLE

TRUTH = load_cell("ncr18650")


def steps(seed=0, duration_s=18_000):
    """Random steps of 20 to 400 s with rests between them, 1 Hz, mean about C/5."""
    rng = np.random.default_rng(seed)
    pieces = [np.zeros(60)]
    while sum(map(len, pieces)) < duration_s:
        pieces += [np.full(rng.integers(20, 400), rng.choice([0.5, 1.0, 2.0, 3.0])), np.zeros(rng.integers(60, 900))]
    return np.concatenate(pieces)[:duration_s]


def constant(current_a=0.75, duration_s=13_000):
    """A constant load from its first sample on."""
    return np.full(duration_s, current_a)


def capture(current_a, *, cell=TRUTH, soc=0.98, noise_v=0.5e-3, seed=0):
    """What a sensor sees of ``cell`` under ``current_a`` at 1 Hz, to SOC 0.03."""
    time_s = np.arange(current_a.size, dtype=float)
    elements = np.zeros(22)
    elements[1 : SIZE + 1] = cell.a[1 : SIZE + 1]
    drop_v, counted = simulate_cell((soc, 0.0, 0.0), time_s, current_a, 3600.0 * cell.cell.capacity_ah, elements)
    grid = ocv_grid(cell)
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = time_s, current_a
    samples["voltage_v"] = np.array([ocv(x, *grid) for x in counted]) + drop_v
    samples["voltage_v"] += noise_v * np.random.default_rng(seed + 100).standard_normal(time_s.size)
    samples["temperature_c"] = np.nan
    return samples[np.minimum.accumulate(counted) > 0.03]


def wrong_start(factor_ohm=1.7, factor_farad=0.6):
    """The true cell with wrong elements."""
    table = TRUTH.model_dump()
    for name, (_, amplitude, offset) in ELEMENTS.items():
        factor = factor_farad if name.startswith("c_") else factor_ohm
        table[name][amplitude] *= factor
        table[name][offset] *= factor
        table[name]["exponent"] *= 1.3
    return CellModel.model_validate(table)
