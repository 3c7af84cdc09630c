"""OCV hysteresis: a simulated cell has the flat OCV of LFP, which is 30 mV higher after charge than after discharge."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.kernels.cell_model.open_loop import hysteresis
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_ACTIVATION_ENERGY, arrhenius
from bms_estimator.kernels.kalman_filter.records import HYST
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.settings.observer import IdentifierSettings

SOC = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
OCV_V = (2.6, 2.95, 3.1, 3.19, 3.215, 3.235, 3.262, 3.274, 3.278, 3.282, 3.29, 3.308, 3.312, 3.315, 3.32, 3.335, 3.4)
"""OCV after discharge, at ``SOC`` [V]."""
CELL = load_cell("ncr18650").model_copy(update={"ladder": None, "ocv": TableOcv(form="table", soc=SOC, ocv_v=OCV_V)})
HYSTERESIS_V = 0.03
"""OCV after charge minus OCV after discharge [V]."""
HYSTERESIS_SOC = 0.05
"""Charge constant of the transition from the OCV after discharge to the OCV after charge [SOC]."""
CAPACITY_AS = CELL.cell.capacity_ah * 3600.0
LEVEL_S, REST_S = 240, 1200
"""Duration of each random current, and of each rest [s]."""


def load_a(rng: np.random.Generator, cycles: int) -> np.ndarray:
    """Return a current at 1 Hz for a full cell [A]. Each cycle is a discharge to SOC 0.15 and a charge to SOC 0.95,
    with random currents and a rest after each."""
    parts, soc = [], 1.0
    for _ in range(cycles):
        for levels_a, end_soc in ((np.array([0.0, 0.75, 1.5, 3.0]), 0.15), (np.array([-0.75, -1.5]), 0.95)):
            while (soc - end_soc) * levels_a[-1] > 0.0:  # the last level has the sign of the phase
                parts.append(np.full(LEVEL_S, rng.choice(levels_a)))
                soc -= parts[-1].sum() / CAPACITY_AS
            parts.append(np.zeros(REST_S))
    return np.concatenate(parts)


def simulate_cycles(seed: int) -> tuple[SampleBlock, np.ndarray]:
    """Return samples of four cycles with 0.5 mV of noise and a resolution of 1 mV, and the true SOC."""
    rng = np.random.default_rng(seed)
    current_a = load_a(rng, 4)
    block = np.zeros(current_a.size, dtype=SAMPLE)
    block["temperature_c"] = 25.0
    block["time_s"], block["current_a"] = np.arange(current_a.size), current_a
    grid, x, soc = ocv_grid(CELL), (1.0, 0.0, 0.0), np.empty(current_a.size)
    charged = 0.0  # 0: OCV after discharge, 1: OCV after charge
    for n, i in enumerate(current_a):
        block["voltage_v"][n] = ocv(x[0], *grid) + charged * HYSTERESIS_V - x[1] - x[2] - i * r_s(x[0], CELL.a)
        soc[n] = x[0]
        x = cell_step(x, i, 1.0, CAPACITY_AS, CELL.a)
        charged += (1.0 - np.exp(-abs(i) / CAPACITY_AS / HYSTERESIS_SOC)) * (float(i < 0.0) - charged)
    block["voltage_v"] = np.round(block["voltage_v"] + rng.normal(0.0, 5e-4, current_a.size), 3)
    return block, soc


def score_run(block: SampleBlock, soc: np.ndarray, hysteresis_v: float) -> tuple[float, float]:
    """Return RMS error of the SOC and fraction of time with the true SOC inside two std, after the first two hours."""
    estimator = Estimator(CELL, identifier=IdentifierSettings(hysteresis_v=hysteresis_v), initial_soc=1.0)
    trace = estimator.run(block)[7200:]
    error = trace["soc"] - soc[7200:]
    return float(np.sqrt(np.mean(error**2))), float(np.mean(np.abs(error) < 2.0 * trace["soc_std"]))


def test_a_configured_hysteresis_improves_soc_and_coverage() -> None:
    loads = [simulate_cycles(seed) for seed in range(1, 3)]
    rms_error, coverage = np.mean([score_run(*load, HYSTERESIS_V) for load in loads], axis=0)
    rms_error_without, _ = np.mean([score_run(*load, 0.0) for load in loads], axis=0)
    assert rms_error < 0.012
    assert rms_error < 0.8 * rms_error_without
    assert coverage > 0.95


@pytest.mark.parametrize("steps_s", [(1.0,), (10.0,), (1.0, 7.0), (1.0, 1.0, 1.0, 8.0)])
def test_regeneration_during_a_discharge_does_not_reverse_the_hysteresis(steps_s: tuple[float, ...]) -> None:
    """For half an hour, 1.5 C and -1 C alternate every 20 s. The charge throughput is five times the net discharge."""
    estimator = Estimator(CELL, identifier=IdentifierSettings(hysteresis_v=0.0), initial_soc=0.8)
    time_s = np.concatenate([[0.0], np.cumsum(np.resize(steps_s, round(1800.0 / np.mean(steps_s))))])
    current_a = CELL.cell.capacity_ah * np.where(time_s % 40.0 < 20.0, 1.5, -1.0)
    f, h = estimator.record["filter"][0], np.zeros(time_s.size)  # h is -1 after discharge and 1 after charge
    for n, (t, i) in enumerate(zip(time_s, current_a, strict=True)):
        estimator.step(t, i, 3.3 - 0.03 * i)
        h[n] = f["mean"][f["best"], HYST]
    hysteresis_soc = float(estimator.settings_record[0]["filter"]["hysteresis_soc"])
    charge_as = 0.5 * (current_a[1:] + current_a[:-1]) * np.diff(time_s)
    expected = hysteresis(time_s, -np.r_[0.0, np.cumsum(charge_as)] / CAPACITY_AS, hysteresis_soc, 0.0)
    late = time_s > 1200.0
    assert h.min() >= -1.0
    assert expected[late].mean() < -0.75
    assert h[late].mean() == pytest.approx(expected[late].mean(), abs=0.1)


def test_hysteresis_grows_in_the_cold() -> None:
    """The hysteresis is the voltage that the filter predicts after a charge minus the one after a discharge."""
    predicted_v = {}
    for h in (-1.0, 1.0):
        for celsius in (-15.0, 25.0):
            estimator = Estimator(CELL, identifier=IdentifierSettings(hysteresis_v=HYSTERESIS_V), initial_soc=0.5)
            estimator.step(0.0, 0.0, 3.28, 0, celsius)
            f = estimator.record[0]["filter"]
            f["count"], f["mean"][:, HYST] = 1, h  # a single hypothesis, whose hysteresis is certain
            f["covariance"][:, HYST] = f["covariance"][:, :, HYST] = 0.0
            estimator.step(1.0, 0.0, 3.28, 0, celsius)
            predicted_v[h, celsius] = f["voltage_v"]
    difference_v = {celsius: predicted_v[1.0, celsius] - predicted_v[-1.0, celsius] for celsius in (-15.0, 25.0)}
    assert difference_v[25.0] == pytest.approx(HYSTERESIS_V, rel=0.01)
    assert difference_v[-15.0] / difference_v[25.0] == pytest.approx(
        arrhenius(HYSTERESIS_ACTIVATION_ENERGY, -15.0), rel=0.01
    )
    assert 1.5 < difference_v[-15.0] / difference_v[25.0] < 1.8
