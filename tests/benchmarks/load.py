"""The load that benchmarks run on: a simulated Chen & Mora cell behind a converter."""

import numpy as np

from bms_estimator.kernels.cell import simulate_cell
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock

RATE_HZ = 100.0
VOLTAGE_STEP_V = 1e-3
CURRENT_STEP_A = 1e-4


def pulses(samples: int) -> SampleBlock:
    """Pulses of 100 mA on the 275 mAh cell of Chen & Mora, 60 s on and 60 s off, at 100 Hz, noisy and rounded.

    Args:
        samples: How many; 900,000 empty the cell to a tenth.
    """
    cell = load_cell("chen_mora")
    block = np.zeros(samples, dtype=SAMPLE)
    time_s = np.arange(samples) / RATE_HZ
    current_a = 0.1 * (time_s % 120.0 < 60.0)
    voltage_v, _ = simulate_cell((0.95, 0.0, 0.0), time_s, current_a, cell.cell.capacity_ah * 3600.0, cell.a)
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, (2, samples))
    block["time_s"] = time_s
    block["current_a"] = np.round(current_a / CURRENT_STEP_A + noise[0]) * CURRENT_STEP_A
    block["voltage_v"] = np.round(voltage_v / VOLTAGE_STEP_V + noise[1]) * VOLTAGE_STEP_V
    block["temperature_c"] = np.nan
    return block
