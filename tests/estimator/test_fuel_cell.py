"""Estimator of a fuel cell: learned parameters, payloads, and invalid samples."""

import math

import numpy as np
import pytest

from bms_estimator.calibration.fuel_cell_fit import KEYS
from bms_estimator.cli.captures.replay_summary import Summary
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.fuel_cell import NAMES
from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.pack_model import load_fuel_cell
from bms_estimator.pack.pack import Pack
from bms_estimator.telemetry.fuel_cell_parameters import fuel_cell_parameters
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.state import remaining_capacity_ah
from tests import mann_stack
from tests.estimator.simulated_cell import run_divided

PEM = load_fuel_cell("pem_30w")
PARAMETERS = 16
"""Size of a parameter array. The parameters ``NAMES`` are at index 1 and following."""
LAST_MINUTE = slice(-6000, None)
"""Last minute of samples at 100 Hz."""


def make_samples(record: mann_stack.Record) -> SampleBlock:
    """Return the samples of a simulated record."""
    samples = np.zeros(record.time_s.size, SAMPLE)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        samples[name] = getattr(record, name)
    return samples


def simulate_model(factors: np.ndarray, duration_s: float, *, seed: int = 0) -> SampleBlock:
    """Return samples at 100 Hz of the model itself, with ``factors`` times the parameters of the file."""
    return make_samples(mann_stack.model_itself(PEM.a * factors, duration_s, seed=seed))


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def learned_parameters(estimator: Estimator) -> dict[str, float]:
    """Return the present parameters of the learning law by name."""
    return dict(zip(NAMES, estimator.state["a"][0][1 : 1 + len(NAMES)], strict=True))


@pytest.fixture(scope="module")
def ten_minutes() -> mann_stack.Record:
    """Return ten minutes of the stack of ``mann_stack`` at 100 Hz. Its contact resistance rises by 60 mohm at 300 s."""
    time_s, current_a = mann_stack.random_steps(600.0, 500.0, seed=4)
    more_ohm = np.where(time_s < 300.0, 0.0, 0.06)
    return mann_stack.measured(time_s, current_a, seed=4, more_ohm=more_ohm).every(5)


def test_run_and_step_leave_the_same_state_to_the_last_bit(ten_minutes: mann_stack.Record) -> None:
    samples = make_samples(ten_minutes)[:3000]
    samples["voltage_v"][100] = np.nan
    samples["voltage_v"][200] = 25.0
    samples["temperature_c"][300:500] = np.nan
    state = run_divided(lambda: Estimator(PEM), samples).state[0]
    assert (state["samples"], state["dropped_not_finite"], state["dropped_range"]) == (2998, 1, 1)


def test_values_that_a_stack_does_not_have_are_nan_in_the_trace_and_null_in_payloads(
    ten_minutes: mann_stack.Record,
) -> None:
    estimator = Estimator(PEM)
    trace = estimator.run(make_samples(ten_minutes)[:500])
    for name in ("soc", "soc_coulomb", "soc_std", "soc_ocv", "delta_1", "delta_2", "stability_margin"):
        assert np.isnan(trace[name]).all(), name
    assert np.isfinite(trace["voltage_estimate_v"]).all()
    assert (trace["lock"] == 1).all()
    assert math.isnan(remaining_capacity_ah(estimator))
    report = make_parameters_payload(estimator, 0.0)
    assert (report.soc, report.a, report.ocv, report.state_of_health) == (None, {}, None, {})
    assert tuple(report.elements) == KEYS
    assert make_parameters_payload(Estimator(PEM), 0.0).elements == {}
    with pytest.raises(ValueError, match="has no SOC"):
        estimator.set_soc(0.5)


def test_a_step_of_the_resistance_is_learned() -> None:
    """The resistance increases by 35 % after ten minutes. All parameters are right ten minutes later."""
    estimator, factors = Estimator(PEM), np.ones(PARAMETERS)
    factors[1 + NAMES.index("r_ohm")] = 1.35
    before, after = simulate_model(np.ones(PARAMETERS), 600.0), simulate_model(factors, 600.0, seed=1)
    after["time_s"] += 600.0
    estimator.run(before)
    assert learned_parameters(estimator)["r_ohm"] == pytest.approx(PEM.fuel_cell.r_ohm, rel=0.05)
    trace = estimator.run(after)
    assert learned_parameters(estimator)["r_ohm"] == pytest.approx(1.35 * PEM.fuel_cell.r_ohm, rel=0.05)
    assert learned_parameters(estimator)["tafel_slope_v"] == pytest.approx(PEM.fuel_cell.tafel_slope_v, rel=0.03)
    assert rms(trace["innovation_v"][:500]) > 0.1
    assert rms(trace["innovation_v"][LAST_MINUTE]) < 0.01


def test_the_voltage_of_a_stack_with_unmodelled_effects_is_tracked(ten_minutes: mann_stack.Record) -> None:
    """A contact resistance of 60 mohm at 300 s causes an error of 180 mV, which falls to 20 mV within four minutes. The
    resistance is within 10 %."""
    estimator = Estimator(PEM)
    trace = estimator.run(make_samples(ten_minutes))
    after_step = (ten_minutes.time_s > 300.0) & (ten_minutes.time_s < 310.0)
    assert rms(trace["innovation_v"][after_step]) > 0.1
    assert rms(trace["innovation_v"][LAST_MINUTE]) < 0.025
    assert learned_parameters(estimator)["r_ohm"] == pytest.approx(ten_minutes.r_ohm[LAST_MINUTE].mean(), rel=0.1)
    assert (trace["lock"][LAST_MINUTE] == 1).all()


def test_wrong_parameters_are_learned_and_reported_as_identified() -> None:
    """The file's parameters are wrong by 5 to 50 %. After ten minutes all are within 3 %."""
    factors = np.array([1.0, 1.5, 0.9, 1.05, 1.3, *[1.0] * 11])  # index 0 is unused
    estimator = Estimator(PEM, voltage_resolution_v=1e-3)
    trace = estimator.run(simulate_model(factors, 600.0))
    assert rms(trace["innovation_v"][LAST_MINUTE]) < 0.008
    parameters = learned_parameters(estimator)
    for name, factor, tolerance in (
        ("r_ohm", 1.5, 0.03),
        ("tafel_slope_v", 0.9, 0.01),
        ("activation_v", 1.05, 0.005),
        ("c_dl_farad", 1.3, 0.03),
    ):
        assert parameters[name] == pytest.approx(factor * PEM.a[1 + NAMES.index(name)], rel=tolerance), name
    published = fuel_cell_parameters(estimator, 0.0)
    assert published["r_ohm"].valid
    assert published["r_ohm"].std is not None
    assert not published["concentration_v"].valid
    assert "known to" in str(published["concentration_v"].reason)


@pytest.mark.parametrize(("state_value", "printed"), [(0.0, 0.0), (math.nan, None), (math.inf, None)])
def test_a_replay_prints_numbers_or_none(state_value: float, printed: float | None) -> None:
    estimator = Estimator(PEM)
    estimator.run(simulate_model(np.ones(PARAMETERS), 2.0))
    estimator.state["a"][0, 1] = state_value
    result = Summary().result(Pack(estimator), math.inf, 1, 1.0)
    r_ohm = result.parameters["r_ohm"]
    assert (r_ohm.value, r_ohm.std) == (printed, printed)


def test_without_a_load_only_the_voltage_is_learned() -> None:
    samples = simulate_model(np.ones(PARAMETERS), 60.0)
    samples["current_a"], samples["voltage_v"] = 0.0, 13.1  # open-circuit voltage
    estimator = Estimator(PEM)
    estimator.run(samples)
    parameters = learned_parameters(estimator)
    for name in ("r_ohm", "c_dl_farad"):
        assert parameters[name] == pytest.approx(PEM.a[1 + NAMES.index(name)], rel=0.02), name
    assert not fuel_cell_parameters(estimator, 0.0)["r_ohm"].valid


def test_a_stack_is_learned_again_after_random_sensor_values() -> None:
    samples = simulate_model(np.ones(PARAMETERS), 720.0)
    faulty = slice(6000, 12000)  # the second minute
    samples["voltage_v"][faulty] = np.random.default_rng(1).uniform(2.0, 18.0, 6000)
    estimator = Estimator(PEM)
    trace = estimator.run(samples)
    assert rms(trace["innovation_v"][faulty]) > 1.0
    assert rms(trace["innovation_v"][LAST_MINUTE]) < 0.01
    assert learned_parameters(estimator)["r_ohm"] == pytest.approx(PEM.fuel_cell.r_ohm, rel=0.1)


@pytest.mark.parametrize("field", ["theta", "x", "dx", "information", "pull", "temperature_c"])
def test_a_non_finite_state_is_initialized_again(field: str) -> None:
    samples = simulate_model(np.ones(PARAMETERS), 90.0)
    estimator = Estimator(PEM)
    estimator.run(samples[:1000])
    estimator.record[0]["learning"][field] = np.nan
    trace = estimator.run(samples[1000:])
    assert np.isfinite(trace["voltage_estimate_v"][300:]).all()
    assert estimator.state["lock_losses"][0] <= 1
    assert rms(trace["innovation_v"][300:]) < 0.01


@pytest.mark.parametrize("celsius", [-273.15, -300.0, -127.0, 1e6, np.inf])
@pytest.mark.parametrize("first", [0, 500])
def test_an_implausible_temperature_is_not_used(first: int, celsius: float) -> None:
    samples = simulate_model(np.ones(PARAMETERS), 10.0)
    without, with_temperature = Estimator(PEM), Estimator(PEM)
    expected_v = without.run(samples)["voltage_estimate_v"].copy()
    samples["temperature_c"][first : first + 2] = celsius
    np.testing.assert_array_equal(with_temperature.run(samples)["voltage_estimate_v"], expected_v)
    assert np.isfinite(expected_v).all()


def test_a_current_with_the_wrong_sign_does_not_change_parameters() -> None:
    samples = simulate_model(np.ones(PARAMETERS), 60.0)
    estimator = Estimator(PEM)
    estimator.run(samples[:2000])
    samples["current_a"][2000:5000] *= -1.0
    estimator.run(samples[2000:5000])
    assert learned_parameters(estimator)["tafel_slope_v"] == pytest.approx(PEM.fuel_cell.tafel_slope_v, rel=0.02)
    assert learned_parameters(estimator)["r_ohm"] == pytest.approx(PEM.fuel_cell.r_ohm, rel=0.05)
    trace = estimator.run(samples[5000:])
    assert rms(trace["innovation_v"][100:]) < 0.02
