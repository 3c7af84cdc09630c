"""R_s from current steps between two samples, at several sample rates and with two cell files."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.equivalent_circuit import R_S
from bms_estimator.kernels.kalman_filter.records import LN_R0
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from tests.estimator.anywhere.cases import OXIDE, Case, cell_file
from tests.estimator.anywhere.truth import simulate

FULL_HZ, HOURS = 100, 0.4
"""Rate and duration of the simulation, which slower sensors sample."""
MIN_STEP_A = 0.5 * OXIDE.capacity_ah
"""Smallest current step whose resistance is compared [A]."""
FILES = {"of another such cell": Case("R_s"), "generic": Case("R_s", file_temperatures_c="generic")}


@pytest.fixture(scope="module")
def pulses() -> tuple[SampleBlock, Floats]:
    """Return samples under random current levels of 3 to 20 s, and the true SOC.

    The current steps between the samples of a slow sensor.
    """
    rng = np.random.default_rng(9)
    count = round(3600 * HOURS * FULL_HZ)
    level_a = OXIDE.capacity_ah * rng.choice([-0.5, 0.0, 0.5, 1.0, 1.5], count)
    samples = np.zeros(count, dtype=SAMPLE)
    lengths, levels = rng.integers(3 * FULL_HZ, 20 * FULL_HZ, count), count // (3 * FULL_HZ)
    samples["current_a"] = np.repeat(level_a[:levels], lengths[:levels])[:count]
    samples["time_s"], samples["temperature_c"] = np.arange(count) / FULL_HZ, 15.0
    samples["voltage_v"], soc = simulate(
        1.0 / FULL_HZ,
        samples["current_a"],
        samples["temperature_c"],
        0.7,  # initial SOC
        -1.0,  # hysteresis after discharge
        OXIDE.capacity_ah,
        OXIDE.ocv_v,
        OXIDE.per_kelvin_v,
        OXIDE.hysteresis_v,
        OXIDE.ohm,
    )
    return samples, soc


def step_resistances(samples: SampleBlock) -> Floats:
    """Return the ratio of voltage change to current change at each current step between two samples [ohm]."""
    change_a, change_v = np.diff(samples["current_a"]), np.diff(samples["voltage_v"])
    steps = np.abs(change_a) >= MIN_STEP_A
    return -change_v[steps] / change_a[steps]


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("rate_hz", [1, 10, 100])
def test_r_s_matches_the_resistance_of_current_steps(pulses, file: str, rate_hz: int) -> None:
    samples = pulses[0][:: FULL_HZ // rate_hz].copy()
    step_ohm = np.median(step_resistances(samples))
    samples["voltage_v"] += np.random.default_rng(10).normal(0.0, 1e-3, samples.size)
    estimator = Estimator(cell_file(FILES[file]), initial_soc=0.5)
    trace = estimator.run(samples)
    late = trace["time_s"] > 0.5 * trace["time_s"][-1]
    r_s, std = trace["r_s_ohm"][late], trace["r_s_std_ohm"][late]
    # At 1 Hz a step includes a part of the fastest RC pairs, which a generic file does not describe at 15 C.
    assert np.abs(r_s / step_ohm - 1.0).max() < (0.12 if (file, rate_hz) == ("generic", 1) else 0.1)
    assert (np.abs(r_s - step_ohm) < 2.0 * std).mean() > 0.95
    assert (std < 0.2 * r_s).all()


def learned_ln_ratio(rows: list[tuple[float, float, float]]) -> float:
    """Run a new estimator over a minute without current and then over rows of time [s], current [A] and voltage [V].

    Returns:
        ln of R_s over the R_0 of the cell file.
    """
    estimator = Estimator(cell_file(FILES["generic"]), initial_soc=0.5)
    for n in range(60):
        estimator.step(float(n), 0.0, 3.7)
    for time_s, current_a, voltage_v in rows:
        estimator.step(time_s, current_a, voltage_v)
    return float(estimator.record[0]["filter"]["step"]["ln_ratio"])


@pytest.mark.parametrize("return_a", [0.0, 0.004])
def test_an_interrupted_step_does_not_change_r_s(return_a: float) -> None:
    """A rejected sample (2.6 V) or a clock set back lies between a current step of 3 A and its return."""
    rejected_sample = [(60.0, 3.0, 3.55), (60.5, 0.0, 2.6), (61.0, return_a, 3.69)]
    clock_set_back = [(60.0, 3.0, 3.55), (59.0, 0.0, 3.7), (60.0, return_a, 3.7)]
    assert learned_ln_ratio(rejected_sample) == learned_ln_ratio(clock_set_back) == 0.0


def test_without_current_steps_r_s_is_that_of_the_filter(pulses) -> None:
    without_steps = pulses[0][::FULL_HZ].copy()
    without_steps["current_a"] = OXIDE.capacity_ah * (0.5 + 0.4 * np.sin(without_steps["time_s"] / 200.0))
    estimator = Estimator(cell_file(FILES["generic"]), initial_soc=0.7)
    estimator.run(without_steps)
    f, elements = estimator.record[0]["filter"], estimator.record[0]["elements"]
    assert f["step"]["ln_ratio"] == 0.0
    # The resistance of a current step is less certain than the R_0 of the filter.
    assert elements["ln_variance"][R_S] > f["covariance"][f["best"], LN_R0, LN_R0]
