"""Simulation of the thesis's cell under random current steps, and cell files with wrong parameters."""

from collections.abc import Sequence

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import simulate_cell
from bms_estimator.kernels.observer.chen_mora_sensitivity import NAMES
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.settings.observer import ObserverSettings

TRUTH = load_cell("chen_mora").model_copy(update={"adaptation": {}})
"""True cell with default bounds, because the bounds of Table 5 of the thesis exclude the parameters of wrong files."""
RATED_A = 0.275
"""Current of 1 C [A]."""
STEPS_C = (-1.0, -0.5, 0.0, 0.0, 0.5, 1.0)
"""Currents of the steps [C]. A rest is twice as frequent as any other current."""
HOLD_S = (20, 400)
"""Range of the duration of a step [s]."""
MIN_SOC, MAX_SOC = 0.3, 0.85
"""Range of the SOC during the steps. A step that would leave the range has the opposite sign."""
FIRST_SOC = 0.6
RESOLUTION_V = 5e-4
"""Configured voltage resolution of the estimators [V]."""
HALF_SECONDS_PER_HOUR = 7200


def file_off_by(*factors: float) -> CellModel:
    """Return the cell's file with R_s, R_ts, tau_ts, R_tl, tau_tl multiplied by factors."""
    r_s, r_ts, tau_ts, r_tl, tau_tl = factors
    scale = {"r_s": r_s, "r_ts": r_ts, "r_tl": r_tl, "c_ts": tau_ts / r_ts, "c_tl": tau_tl / r_tl}
    parts = {}
    for name, factor in scale.items():
        part = getattr(TRUTH, name)
        keys = [key for key in part.model_dump() if key != "exponent"]
        parts[name] = part.model_copy(update={key: getattr(part, key) * factor for key in keys})
    return TRUTH.model_copy(update=parts)


def held_currents(hours: float, rng: np.random.Generator) -> np.ndarray:
    """Return a random current that is held for random times, one value for each half second [A].

    The first half second has no current, so that the current changes midway between the samples of ``measured``.
    """
    n, soc = int(hours * HALF_SECONDS_PER_HOUR), FIRST_SOC
    current_a, i = np.zeros(n), 1
    while i < n:
        half_seconds = 2 * int(rng.integers(*HOLD_S))
        step_c = rng.choice(STEPS_C)
        soc_drop = step_c * half_seconds / HALF_SECONDS_PER_HOUR
        if not MIN_SOC < soc - soc_drop < MAX_SOC:
            step_c, soc_drop = -step_c, -soc_drop
        current_a[i : i + half_seconds] = step_c * RATED_A
        soc, i = soc - soc_drop, i + half_seconds
    return current_a


def random_steps(hours: float, noise_v: float = 0.0, seed: int = 1, cell: CellModel = TRUTH) -> SampleBlock:
    """Return samples of ``cell`` at 1 Hz under random current steps; ``noise_v`` is the std of the voltage noise
    [V]."""
    rng = np.random.default_rng(seed)
    return measured(held_currents(hours, rng), noise_v, rng, cell)


def measured(current_a: np.ndarray, noise_v: float, rng: np.random.Generator, cell: CellModel = TRUTH) -> SampleBlock:
    """Return a sensor's samples of ``cell`` at 1 Hz; ``current_a`` has one value for each half second [A]."""
    time_s = 0.5 * np.arange(len(current_a))
    voltage_v, _ = simulate_cell((FIRST_SOC, 0.0, 0.0), time_s, current_a, cell.cell.capacity_ah * 3600.0, cell.a)
    block = np.zeros(len(current_a[::2]), dtype=SAMPLE)
    block["time_s"], block["current_a"], block["temperature_c"] = time_s[::2], current_a[::2], np.nan
    block["voltage_v"] = voltage_v[::2] + rng.normal(0.0, noise_v, block.size)
    return block


def learner(file: CellModel, soc: float = FIRST_SOC, **observer: float) -> Estimator:
    """Return an estimator without the filter that starts at ``soc``, with the learning law and other settings
    ``observer``."""
    settings = ObserverSettings.model_validate({"law": "learning", **observer})
    return Estimator(file, settings, identifier=None, initial_soc=soc, voltage_resolution_v=RESOLUTION_V)


def relative_errors(estimator: Estimator, factors: Sequence[float]) -> np.ndarray:
    """Return the relative errors of the learned parameters, for a file with wrong ``factors``; shape (5,)."""
    theta = estimator.record[0]["learning"]["theta"][: len(NAMES)]
    return np.abs(np.exp(theta) * np.asarray(factors) - 1.0)
