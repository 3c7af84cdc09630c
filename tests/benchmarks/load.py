"""Simulated load of the benchmarks: the pack of the thesis under current pulses, measured by a board."""

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell

CELL = "thunder_power_6s"
RATE_HZ = 100
"""Default sample rate [Hz]."""
VOLTAGE_STEP_V = 25.0 / 1024 / 16
"""Resolution of the mean of sixteen conversions of a 10-bit ADC of 5 V behind a 5:1 divider [V]."""
CURRENT_STEP_A = 5.0 / 1024 / 0.1 / 16
"""Resolution of the mean of sixteen conversions of the sensor's output, 0.1 V/A [A]."""
ON_A = 0.7
"""Current of a pulse [A]. Sixteen hours of pulses discharge the pack from SOC 0.90 to 0.05."""
HALF_PERIOD_S = 60.0
"""Duration of a pulse, and of the pause after it [s]."""


def pulses(samples: int, rate_hz: int = RATE_HZ) -> SampleBlock:
    """Return samples under current pulses with the noise and resolution of a board.

    Args:
        samples: Number of samples.
        rate_hz: Sample rate [Hz].
    """
    cell = load_cell(CELL)
    block = np.zeros(samples, dtype=SAMPLE)
    time_s = np.arange(samples) / rate_hz
    current_a = ON_A * (time_s % (2.0 * HALF_PERIOD_S) < HALF_PERIOD_S)
    initial_state = (0.9, 0.0, 0.0)  # SOC and both RC voltages
    voltage_v, _ = simulate_cell(initial_state, time_s, current_a, cell.cell.capacity_ah * 3600.0, cell.a)
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, (2, samples))
    block["time_s"] = time_s
    block["current_a"] = np.round(current_a / CURRENT_STEP_A + noise[0]) * CURRENT_STEP_A
    block["voltage_v"] = np.round(voltage_v / VOLTAGE_STEP_V + noise[1]) * VOLTAGE_STEP_V
    block["temperature_c"] = np.nan
    return block
