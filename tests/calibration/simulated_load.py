"""Simulated captures of loads, for tests of the calibration."""

import numpy as np
from scipy.signal import lfilter

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv, simulate_cell
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import ELEMENTS, Ladder

TRUTH = load_cell("ncr18650").model_copy(update={"ladder": None})
"""True cell with two RC pairs, equations (2.2)-(2.9) of the thesis."""
MIN_SOC = 0.03
"""SOC at which simulated captures end."""


def steps(seed=0, duration_s=18_000):
    """Return a current at 1 Hz of random steps of 20 to 400 s with rests of 1 to 15 min [A]. Its mean is about C/5."""
    rng = np.random.default_rng(seed)
    pieces = [np.zeros(60)]
    while sum(map(len, pieces)) < duration_s:
        pieces += [np.full(rng.integers(20, 400), rng.choice([0.5, 1.0, 2.0, 3.0])), np.zeros(rng.integers(60, 900))]
    return np.concatenate(pieces)[:duration_s]


def constant(current_a=0.75, duration_s=13_000):
    """Return a constant current at 1 Hz [A]."""
    return np.full(duration_s, current_a)


def capture(current_a, *, cell=TRUTH, soc=0.98, noise_v=0.5e-3, seed=0):
    """Return the samples of ``cell`` under ``current_a`` at 1 Hz, from rest at ``soc`` until ``MIN_SOC``."""
    time_s = np.arange(current_a.size, dtype=float)
    elements = np.zeros(22)  # without a16..a21, the OCV is 0
    elements[1:16] = cell.a[1:16]
    rc_and_ohmic_v, true_soc = simulate_cell(
        (soc, 0.0, 0.0), time_s, current_a, 3600.0 * cell.cell.capacity_ah, elements
    )
    grid = ocv_grid(cell)
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = time_s, current_a
    samples["voltage_v"] = np.array([ocv(x, *grid) for x in true_soc]) + rc_and_ohmic_v
    samples["voltage_v"] += noise_v * np.random.default_rng(seed + 100).standard_normal(time_s.size)
    samples["temperature_c"] = np.nan
    return samples[np.minimum.accumulate(true_soc) > MIN_SOC]


def wrong_start(factor_ohm=1.7, factor_farad=0.6):
    """Return the true cell with wrong elements.

    Amplitudes and offsets of resistances are multiplied by ``factor_ohm`` and those of capacitances by
    ``factor_farad``. Exponents are multiplied by 1.3.
    """
    table = TRUTH.model_dump()
    for name, (_, amplitude, offset) in ELEMENTS.items():
        factor = factor_farad if name.startswith("c_") else factor_ohm
        table[name][amplitude] *= factor
        table[name][offset] *= factor
        table[name]["exponent"] *= 1.3
    return CellModel.model_validate(table)


GAS_CONSTANT = 8.314462618
"""Gas constant [J/(mol K)]."""
LADDER = Ladder(
    soc=(0.0, 0.2, 1.0),
    weak_ohm=((0.05, 0.02, 0.02), *((0.01, 0.004, 0.004),) * 6),
    strong_ohm=((0.02, 0.008, 0.008), *((0.008, 0.004, 0.004),) * 6),
    std=0.1,
    error_v=0.005,
    temperature_c=(-20.0, 45.0),
)
"""RC ladder of the cell that ``ladder_capture`` simulates."""


def ladder_capture(current_a, temperature_c, *, soc=0.98, noise_v=0.5e-3, seed=0, reported_c=None):
    """Return a capture at 1 Hz of ``TRUTH`` with ``LADDER`` as its elements, at a constant temperature.

    The temperature sensor reports ``reported_c`` if it is given, and ``temperature_c`` otherwise.
    """
    time_s = np.arange(current_a.size, dtype=float)
    discharged_as = np.r_[0.0, np.cumsum(current_a[:-1])]
    true_soc = soc - discharged_as / (3600.0 * TRUTH.cell.capacity_ah)
    inverse_kelvin_difference = 1.0 / (temperature_c + 273.15) - 1.0 / 298.15
    # Activation energies of the weak and the strong dependence on temperature [J/mol].
    factors = [np.exp(energy_j / GAS_CONSTANT * inverse_kelvin_difference) for energy_j in (12e3, 45e3)]
    mean_a = 0.5 * (current_a[1:] + current_a[:-1])
    drop_v = np.zeros(time_s.size)
    for k, tau_s in enumerate((0.0, 1.0, 6.0, 30.0, 120.0, 500.0, 2000.0)):  # the first is the series resistance
        decay = np.exp(-1.0 / tau_s) if k else 0.0
        filtered_a = np.r_[0.0, lfilter([1.0 - decay], [1.0, -decay], mean_a)] if k else current_a
        for factor, rows in zip(factors, (LADDER.weak_ohm, LADDER.strong_ohm), strict=True):
            drop_v += factor * np.interp(true_soc, LADDER.soc, rows[k]) * filtered_a
    grid = ocv_grid(TRUTH)
    samples = np.zeros(time_s.size, dtype=SAMPLE)
    samples["time_s"], samples["current_a"] = time_s, current_a
    samples["voltage_v"] = np.array([ocv(x, *grid) for x in true_soc]) - drop_v
    samples["voltage_v"] += noise_v * np.random.default_rng(seed + 100).standard_normal(time_s.size)
    samples["temperature_c"] = temperature_c if reported_c is None else reported_c
    return samples[np.minimum.accumulate(true_soc) > MIN_SOC]
