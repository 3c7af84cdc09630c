"""Published values: remaining charge, identified parameters, state of health, and suspected input faults."""

import math

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.restore import restore_state
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.model.arrays import SAMPLE, fields
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import IdentifierSettings
from bms_estimator.telemetry.health import identifier_counters, suspicions
from bms_estimator.telemetry.parameters import make_parameters_payload
from bms_estimator.telemetry.state import remaining_capacity_ah
from tests.estimator.anywhere.cases import Case, capture

CELL = load_cell("chen_mora").model_copy(update={"adaptation": {}})
"""Cell without bounds of the adaptation, so that parameters start at the values of the file."""
CAPACITY_AH = CELL.cell.capacity_ah
NOW_S = 1.7e9
"""Wall clock of the publications [s since 1970]."""


def estimator_at(soc: float) -> Estimator:
    """Return an estimator after one sample at rest at this SOC."""
    estimator = Estimator(CELL, initial_soc=soc, identifier=None)
    estimator.step(0.0, 0.0, chen_mora.emf(soc, CELL.a))
    return estimator


def pulses(current_a: float, hours: float) -> np.ndarray:
    """Return 10 Hz samples of the cell under current pulses of one minute with rests of one minute."""
    block = np.zeros(int(36_000 * hours), dtype=SAMPLE)
    block["temperature_c"] = 25.0
    block["time_s"] = 0.1 * np.arange(block.size)
    block["current_a"] = np.where(np.arange(block.size) // 600 % 2 == 0, current_a, 0.0)
    block["voltage_v"], _ = chen_mora.simulate_cell(
        (1.0, 0.0, 0.0), block["time_s"].copy(), block["current_a"].copy(), CAPACITY_AH * 3600.0, CELL.a
    )
    return block


def test_the_remaining_charge_is_that_to_soc_0() -> None:
    assert remaining_capacity_ah(estimator_at(0.5)) == pytest.approx(0.5 * CAPACITY_AH)


def test_no_values_are_published_before_the_first_sample() -> None:
    estimator = Estimator(CELL, initial_soc=0.5, identifier=None)
    assert math.isnan(remaining_capacity_ah(estimator))
    assert make_parameters_payload(estimator, NOW_S).elements == {}


def test_identified_elements_and_state_of_health_are_published_with_their_errors() -> None:
    estimator = Estimator(CELL, identifier=IdentifierSettings(), initial_soc=1.0)
    assert estimator.run(pulses(0.2, 0.01))["soc_std"][-1] > 0.0
    estimator = Estimator(CELL, identifier=IdentifierSettings(), initial_soc=1.0)
    estimator.run(pulses(0.2, 2.5))
    report = make_parameters_payload(estimator, NOW_S)
    r_s = report.elements["r_s_ohm"]
    assert (r_s.source, r_s.valid, r_s.reason) == ("identified", True, None)
    assert r_s.updated is not None
    assert r_s.value is not None
    assert r_s.std is not None
    truth = chen_mora.r_s(float(estimator.state[0]["soc"]), CELL.a)
    assert abs(r_s.value - truth) < max(3.0 * r_s.std, 0.02 * truth)
    health = report.state_of_health
    assert health["r_s"].value == pytest.approx(1.0, abs=0.03)
    capacity, offset_a = health["capacity"], health["current_offset_a"]
    assert capacity.value == pytest.approx(1.0, abs=0.03)
    assert (capacity.source, capacity.valid) == ("identified", False)
    assert 0.005 < capacity.std < estimator.settings_record["filter"]["capacity_std"][0]
    assert "valid below 0.02" in (capacity.reason or "")
    assert abs(offset_a.value) < 2.0 * offset_a.std <= 2.0 * 0.007 * CAPACITY_AH  # the initial std is 0.007 C
    assert report.a["a15"].std is not None
    assert report.elements["e_o_v"].source == "configured"
    a1, target = report.a["a1"], float(estimator.state["target"][0, 1])
    assert target != estimator.settings["target"][0, 1]
    # The parameter is not valid, because the SOC changed little.
    assert (a1.value, a1.source, a1.valid) == (pytest.approx(target, rel=1e-3), "identified", False)
    assert abs(a1.value - CELL.a[1]) < 3.0 * a1.std
    uncertain = [p for p in (*report.a.values(), *report.elements.values()) if p.source == "identified" and not p.valid]
    assert all(p.std is not None for p in uncertain)
    assert "identified to" in (a1.reason or "")
    assert "configured" not in (a1.reason or "")


def test_samples_rejected_by_the_identifier_are_counted_since_the_start() -> None:
    estimator = Estimator(CELL, identifier=IdentifierSettings(), initial_soc=1.0)
    block = pulses(0.2, 0.1)
    block["voltage_v"][3000:3003] = 2.6  # three glitches
    estimator.run(block)
    assert identifier_counters(estimator.record[0])["gated"] == 3
    restore_state(estimator, dict(fields(estimator.record.copy())), 1.0)
    assert set(identifier_counters(estimator.record[0]).values()) == {0}
    assert suspicions(estimator.record[0], estimator.settings_record[0]) == []


def test_parameters_are_the_configured_ones_before_the_first_load() -> None:
    estimator = Estimator(CELL, initial_soc=0.5)
    block = pulses(0.0, 0.1)
    estimator.run(block)
    report = make_parameters_payload(estimator, NOW_S)
    assert {p.source for p in report.elements.values()} == {"configured"}
    assert {p.valid for p in report.state_of_health.values()} == {False}


def test_the_published_ocv_curve_contains_the_learned_correction() -> None:
    """The true curve lies 20 mV above the generic one. A rest at SOC 0.9 corrects the curve and its std only there."""
    estimator = Estimator(load_cell("nmc", 3.0), initial_soc=0.9, identifier=IdentifierSettings(soc_std=0.005))
    p = estimator.settings_record[0]["filter"]
    true_v = chen_mora.ocv(0.9, p["ocv_v"], p["ocv_slope_v"]) + 0.020
    estimator.step(0.0, 0.0, true_v)
    first = make_parameters_payload(estimator, NOW_S).ocv
    for i in range(1, 3600):
        estimator.step(float(i), 0.0, true_v)
    curve = make_parameters_payload(estimator, NOW_S).ocv
    assert first is not None
    assert curve is not None
    near, far = curve.soc.index(0.9), curve.soc.index(0.2)
    assert abs(curve.ocv_v[near] - true_v) < 0.3 * 0.020
    assert curve.std_v[near] < 0.5 * float(np.interp(0.9, np.linspace(0.0, 1.0, 41), p["curve_error_v"]))
    assert curve.std_v[far] > 0.8 * float(np.interp(0.2, np.linspace(0.0, 1.0, 41), p["curve_error_v"]))
    assert abs(curve.ocv_v[far] - chen_mora.ocv(0.2, p["ocv_v"], p["ocv_slope_v"])) < curve.std_v[far]


@pytest.mark.parametrize("name", ["ncr18650", "nmc", "lfp"])
def test_parameters_of_a_tabulated_curve_are_those_of_the_fitted_formula(name: str) -> None:
    """The formula, (2.10) of the thesis, is fitted to the table of the cell file, for a cell and for a pack."""
    for cells in (1, 6):
        estimator = Estimator(load_cell(name, 3.0).pack(cells, 1))
        a = make_parameters_payload(estimator, NOW_S).a
        values = np.array([math.nan] * 16 + [a[f"a{i}"].value for i in range(16, 22)])  # a16..a21 of the OCV
        curve_v = estimator.settings[0]["ocv_v"][::4]
        error_v = np.array([chen_mora.emf(soc, values) for soc in np.linspace(0.0, 1.0, curve_v.size)]) - curve_v
        rms_mv = 1e3 * np.sqrt(np.mean(error_v**2))
        assert rms_mv < 30.0 * cells
        assert a["a18"].reason == f"(2.10) fitted to the table of the cell file, {rms_mv:.1f} mV RMS off it"
        assert (a["a18"].source, a["a18"].valid) == ("configured", False)
        assert 0.0 < (a["a18"].std or 0.0) < 0.02 * cells


def test_quantities_with_a_std_of_zero_are_not_identified() -> None:
    exact = IdentifierSettings(capacity_std=0.0, current_offset_std_a=0.0)
    estimator = Estimator(CELL, identifier=exact, initial_soc=1.0)
    estimator.run(pulses(0.2, 0.1))
    health = make_parameters_payload(estimator, NOW_S).state_of_health
    assert (health["capacity"].value, health["current_offset_a"].value) == (1.0, 0.0)
    assert "identifier.capacity_std is 0: the configured value counts as exact" in (health["capacity"].reason or "")


@pytest.mark.parametrize(
    ("temperature_c", "expected"), [(25.0, ""), (-8.0, "no data at -8 C, the cell file knows 15 to 35 C")]
)
def test_a_temperature_outside_the_cell_file_s_range_is_reported(temperature_c: float, expected: str) -> None:
    estimator = Estimator(CELL, initial_soc=1.0)
    block = pulses(0.2, 0.1)
    block["temperature_c"] = temperature_c
    estimator.run(block)
    texts = suspicions(estimator.record[0], estimator.settings_record[0])
    assert (" ".join(texts) if texts else "").startswith(expected)
    assert bool(texts) == bool(expected)


def test_a_current_with_the_wrong_sign_is_suspected() -> None:
    estimator = Estimator(CELL, identifier=IdentifierSettings(), initial_soc=1.0)
    block = pulses(0.2, 1.0)
    block["current_a"] *= -1.0
    estimator.run(block)
    assert any(
        "check the sign of the current" in text
        for text in suspicions(estimator.record[0], estimator.settings_record[0])
    )
    with_right_sign = Estimator(CELL, identifier=IdentifierSettings(), initial_soc=1.0)
    with_right_sign.run(pulses(0.2, 1.0))
    assert suspicions(with_right_sign.record[0], with_right_sign.settings_record[0]) == []


def test_series_resistance_is_compared_with_that_of_the_cell_file_at_the_same_temperature() -> None:
    ratios = []
    for temperature_c in (25.0, 0.0):
        recording = capture(Case("R_s", temperature_c=temperature_c, hours=0.5))
        estimator = Estimator(recording.cell, initial_soc=float(recording.soc[0]))
        estimator.run(recording.samples)
        r_s = make_parameters_payload(estimator, NOW_S).state_of_health["r_s"]
        assert r_s.source == "identified"
        ratios.append(r_s.value)
    # The cell file describes another cell of this type, whose resistance differs by 10 %.
    assert ratios == pytest.approx([1.0, 1.0], abs=0.15)
    assert ratios[1] == pytest.approx(ratios[0], rel=0.1)
