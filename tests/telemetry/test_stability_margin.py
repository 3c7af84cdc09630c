"""Published stability margin: when there is one, its standard deviation, and the reason why there is none."""

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator, TraceBlock, make_estimator
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, SampleBlock
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import load_model
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.publish_window import ChargeEnergy, Window
from bms_estimator.telemetry.state import (
    ALWAYS_STABLE,
    NOT_IDENTIFIED,
    UNKNOWN_SOC,
    make_state_payload,
    no_forecast,
    remaining_capacity_ah,
)
from tests.estimator.simulated_cell import TRUTH, pulses, wrong_cell
from tests.telemetry.alarm_captures import WALL_S, settings
from tests.telemetry.test_parameters import CAPACITANCE_NAMES, file_with_ladder

FIT_S = 120
"""Duration of a block: time between two fits of an element."""
TRUE_LIMIT = max(delta(*TRUTH.a[[8, 9, 7]]), delta(*TRUTH.a[[11, 12, 10]]))
"""SOC below which a capacitance of the true cell is negative."""


def published_state(estimator: Estimator, trace: TraceBlock) -> Estimate:
    """Return the state that is published after a block whose estimates are ``trace``, the only one of the run."""
    window = Window()
    window.add(trace, 0.0)
    summary = window.take()
    assert summary is not None
    left_ah = remaining_capacity_ah(estimator)
    return make_state_payload(summary, left_ah, no_forecast("none"), {}, 0.0, ChargeEnergy(), None)


@pytest.fixture(scope="module")
def three_hours() -> tuple[SampleBlock, np.ndarray]:
    """Return samples of the true cell, discharged from full by pulses, and its true SOC."""
    return pulses()


def rest_at(voltage_v: float) -> SampleBlock:
    """Return a minute of samples of a pack at rest."""
    block = np.zeros(60, dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["temperature_c"] = np.arange(60.0), voltage_v, 25.0
    return block


def test_a_margin_is_published_only_while_all_parameters_of_the_capacitances_are_valid(
    three_hours: tuple[SampleBlock, np.ndarray],
) -> None:
    block, true_soc = three_hours
    estimator = Estimator(file_with_ladder(0.1), identifier=IdentifierSettings(), initial_soc=1.0)
    found = []
    for begin in range(0, block.size, FIT_S):
        state = published_state(estimator, estimator.run(block[begin : begin + FIT_S]))
        parameters = make_parameters_payload(estimator, 0.0).a
        is_valid = all(parameters[name].valid for name in CAPACITANCE_NAMES)
        assert (state.stability_margin is not None) == is_valid
        assert (state.stability_margin_std is not None) == is_valid
        assert state.stability_margin_reason == (None if is_valid else NOT_IDENTIFIED)
        is_configured = all(parameters[name].source == "configured" for name in CAPACITANCE_NAMES)
        if not any(parameters[name].source == "configured" for name in CAPACITANCE_NAMES) or is_configured:
            assert state.delta_configured is is_configured
        found.append((is_valid, state.delta_configured))
    assert set(found) == {(False, True), (False, False), (True, False)}
    assert state.stability_margin is not None
    assert state.stability_margin_std is not None
    assert state.soc is not None
    assert state.soc_std is not None
    assert state.stability_margin == state.soc - max(state.delta_1 or 0.0, state.delta_2 or 0.0)
    assert state.soc_std < state.stability_margin_std < 0.05
    assert abs(state.stability_margin - (true_soc[-1] - TRUE_LIMIT)) < 2.0 * state.stability_margin_std


@pytest.mark.parametrize("cell", ["lfp", "nmc", "nca", "lco", "lmo", "lto"])
def test_a_generic_pack_has_no_margin_because_its_formula_is_stable_at_each_soc(cell: str) -> None:
    model = load_cell(cell, 100.0)
    estimator = Estimator(model, identifier=IdentifierSettings(), initial_soc=0.5)
    state = published_state(estimator, estimator.run(rest_at(model.cell.nominal_voltage_v)))
    assert (state.stability_margin, state.stability_margin_std) == (None, None)
    assert (state.stability_margin_reason, state.delta_configured) == (ALWAYS_STABLE, True)


@pytest.mark.parametrize("law", ["learning", "improved"])
def test_the_limits_of_a_cell_file_alone_give_no_margin(law: str) -> None:
    """Without the identifier, a7..a12 converge to values that the bounds of the file determine, not the data."""
    observer = ObserverSettings.model_validate({"law": law})
    estimator = Estimator(load_cell("chen_mora"), observer, identifier=None, initial_soc=0.5)
    state = published_state(estimator, estimator.run(pulses(hours=0.05)[0]))
    assert max(state.delta_1 or 0.0, state.delta_2 or 0.0) > 0.0
    assert (state.stability_margin, state.delta_configured) == (None, True)
    assert state.stability_margin_reason == NOT_IDENTIFIED


def test_the_alarm_is_raised_only_with_a_margin(three_hours: tuple[SampleBlock, np.ndarray]) -> None:
    """SOC minus max(delta_1, delta_2) is below the limit long before the first margin."""
    block, cell = three_hours[0], file_with_ladder(0.1)
    limits = settings({"stability_margin_low": {"limit": 0.25, "clear": 0.3}})
    estimator, active, low = Estimator(cell, identifier=IdentifierSettings(), initial_soc=1.0), [], []
    alarms = AlarmEvaluator(limits, estimator)
    for begin in range(0, block.size, FIT_S):
        samples = block[begin : begin + FIT_S]
        trace = estimator.run(samples)
        alarms.evaluate(samples, trace, NO_CELLS, WALL_S + begin)
        low.append(trace["soc"][-1] - max(trace["delta_1"][-1], trace["delta_2"][-1]) < 0.25)
        active.append("stability_margin_low" in alarms.active)
        assert active[-1] == bool(np.isfinite(trace["stability_margin"][-1]))
    assert sum(low) > sum(active) > 0


def test_an_unknown_soc_is_the_reason_for_a_missing_margin() -> None:
    estimator = Estimator(load_cell("lfp", 100.0), identifier=IdentifierSettings())
    trace = estimator.run(rest_at(3.3))  # on the plateau of the OCV
    trace["stability_margin"], trace["stability_margin_std"] = 0.3, 0.4
    state = published_state(estimator, trace)
    assert (state.soc_known, state.stability_margin, state.stability_margin_std) == (False, None, None)
    assert state.stability_margin_reason == UNKNOWN_SOC


def test_a_fuel_cell_has_neither_limits_nor_a_margin() -> None:
    estimator = make_estimator(Settings(), load_model("pem_30w"))
    state = published_state(estimator, estimator.run(rest_at(estimator.cell.cell.nominal_voltage_v)))
    assert (state.delta_1, state.delta_configured, state.stability_margin) == (None, False, None)
    assert state.stability_margin_reason is None


def test_innovation_and_not_the_error_of_the_observer_shows_resistances_that_are_ten_times_too_large() -> None:
    block, errors = pulses(hours=0.25)[0], []
    estimator = Estimator(wrong_cell(10.0), identifier=IdentifierSettings(), initial_soc=1.0)
    estimator.run(block[:FIT_S])
    for n in range(FIT_S, block.size):
        trace = estimator.run(block[n : n + 1])
        if trace.size == 0:  # the sample waits for the next one, which confirms its current
            continue
        state = published_state(estimator, trace)
        assert state.voltage_estimate_v is not None
        assert state.innovation_v == pytest.approx(state.voltage_v - state.voltage_estimate_v, abs=1e-12)
        assert state.lock
        errors.append((state.innovation_v, state.tracking_error_v))
    innovation_v, tracking_v = np.sqrt(np.mean(np.square(np.array(errors, float)), axis=0))
    assert innovation_v > 0.1
    assert tracking_v < 0.02


def test_the_estimated_voltage_belongs_to_the_mean_voltage_of_the_publish_window() -> None:
    block = pulses(hours=0.1)[0]
    estimator = Estimator(wrong_cell(1.0), identifier=IdentifierSettings(), initial_soc=1.0)
    trace = estimator.run(block)
    assert np.ptp(trace["voltage_v"]) > 0.1
    state = published_state(estimator, trace)
    assert state.voltage_estimate_v is not None
    assert state.innovation_v == pytest.approx(state.voltage_v - state.voltage_estimate_v, abs=1e-12)
