"""Simulation of a cell with two RC pairs under random pulses, and cell files with wrong parameters."""

from collections.abc import Callable

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.cell_model.open_loop import branch_currents
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell

TRUTH = load_cell("ncr18650").model_copy(update={"ladder": None})
"""True cell. It has no RC ladder, because it is simulated with the two RC pairs of its file."""
NOISE_V = 3e-4
"""Std of the noise of a measured voltage [V]."""
RESOLUTION_V = 1e-3
"""Resolution of a measured voltage [V]."""
LEVELS_A = [0.0, 0.0, 0.75, 1.5, 3.0, -0.5]
"""Currents of the pulses. Rests are twice as frequent as any other level."""
LEVEL_S = 60
"""Duration of each current level [s]."""


def wrong_cell(factor: float) -> CellModel:
    """Return the file of a cell whose resistances are ``factor`` times the true ones."""
    parts = {}
    for name in ("r_s", "r_ts", "r_tl"):
        part = getattr(TRUTH, name)
        parts[name] = part.model_copy(
            update={"amplitude_ohm": part.amplitude_ohm * factor, "offset_ohm": part.offset_ohm * factor}
        )
    return TRUTH.model_copy(update=parts)


def run_divided(make: Callable[[], Estimator], block: SampleBlock) -> Estimator:
    """Check that samples leave the same record at once, one by one and in parts. Return the estimator of all at once."""
    at_once, stepped, in_parts = make(), make(), make()
    at_once.run(block)
    for time_s, current_a, voltage_v, temperature_c, *_, status in block.tolist():
        stepped.step(time_s, current_a, voltage_v, status, temperature_c)
    for part in np.array_split(block, 37):
        in_parts.run(part)
    assert at_once.record.tobytes() == stepped.record.tobytes() == in_parts.record.tobytes()
    return at_once


def pulses(soc: float = 1.0, hours: float = 3.0, seed: int = 1) -> tuple[SampleBlock, np.ndarray]:
    """Return samples at 1 Hz of random pulses and rests, which empty the true cell from ``soc``, and its true SOC."""
    rng = np.random.default_rng(seed)
    levels_a = rng.choice(LEVELS_A, int(3600 * hours) // LEVEL_S)
    return measured(np.repeat(levels_a, LEVEL_S), soc, rng)


def measured(
    current_a: np.ndarray, soc: float, rng: np.random.Generator, *, step_s: float = 1.0
) -> tuple[SampleBlock, np.ndarray]:
    """Return a sensor's samples of the true cell, which starts from rest at ``soc``, and its true SOC.

    Each element of ``current_a`` [A] flows for ``step_s``.
    """
    block = np.zeros(current_a.size, dtype=SAMPLE)
    block["temperature_c"] = 25.0
    block["time_s"] = step_s * np.arange(block.size)
    block["current_a"] = current_a
    ocv_v, slope_v = ocv_grid(TRUTH)
    a, capacity_as = TRUTH.a, TRUTH.cell.capacity_ah * 3600.0
    x, true_soc = (soc, 0.0, 0.0), np.empty(block.size)  # x is SOC and the voltages of both RC pairs
    for n, i_a in enumerate(current_a):
        block["voltage_v"][n] = chen_mora.ocv(x[0], ocv_v, slope_v) - x[1] - x[2] - i_a * chen_mora.r_s(x[0], a)
        true_soc[n] = x[0]
        x = chen_mora.cell_step(x, i_a, step_s, capacity_as, a)
    noisy_v = block["voltage_v"] + rng.normal(0, NOISE_V, block.size)
    block["voltage_v"] = np.round(noisy_v / RESOLUTION_V) * RESOLUTION_V
    return block, true_soc


def simulate_file(cell: CellModel, current_a: np.ndarray, soc: float) -> tuple[SampleBlock, np.ndarray]:
    """Return samples at 1 Hz of the cell of a file with an RC ladder, from rest at ``soc`` and 25 C, and its true SOC.

    The voltage has a resolution of 1 mV.
    """
    p = Estimator(cell).cell_file_settings
    samples = np.zeros(current_a.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(current_a.size), current_a, 25.0
    true_soc = soc - np.cumsum(current_a) / p["capacity_as"]
    ohm = p["weak_ohm"] + p["strong_ohm"]
    grid = np.linspace(0.0, 1.0, ohm.shape[0])
    currents_a = np.column_stack([current_a, branch_currents(samples["time_s"], current_a)])
    voltage_drop_v = sum(np.interp(true_soc, grid, ohm[:, k]) * currents_a[:, k] for k in range(1 + BRANCHES))
    ocv_v = np.array([chen_mora.ocv(x, p["ocv_v"], p["ocv_slope_v"]) for x in true_soc])
    samples["voltage_v"] = np.round(ocv_v - voltage_drop_v, 3)
    return samples, true_soc
