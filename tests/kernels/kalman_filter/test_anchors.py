"""Anchors: which ends of charge and discharge define SOC 1 and SOC 0, and how they correct the filter."""

from collections.abc import Iterable

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.rc_ladder import TAUS
from bms_estimator.kernels.kalman_filter.anchors import EMPTY, FULL, apply_anchor, detect_anchor
from bms_estimator.kernels.kalman_filter.records import B_SLOW, LN_Q, NODE, NODES, OFFSET, SOC
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import NO_LIMITS, ChargeLimits

CAPACITY_AH = 2.0
Phase = tuple[int, float, float]
"""Duration [s], current [C] and voltage [V]."""
CHARGE: Phase = (1800, -0.5, 4.0)
TAIL: Phase = (600, -0.08, 4.2)
REST: Phase = (300, 0.0, 4.17)


class Detector:
    """Detector of anchors of a filter that has had one sample.

    Attributes:
        estimator: The estimator whose records are used.
    """

    def __init__(self, chemistry: str = "nmc", temperature_c: float = 25.0, limits: ChargeLimits = NO_LIMITS) -> None:
        self.estimator = Estimator(load_cell(chemistry, CAPACITY_AH), limits=limits, initial_soc=0.5)
        self.estimator.step(0.0, 0.0, 3.6, temperature_c=temperature_c)

    def kinds(self, phases: Iterable[Phase], window_s: int = 1) -> list[int]:
        """Return the anchors of the phases, in windows of ``window_s``."""
        state, settings = self.estimator.record[0], self.estimator.settings_record[0]
        f, found = state["filter"], []
        for duration_s, current_c, voltage_v in phases:
            current_a = CAPACITY_AH * current_c
            for _ in range(duration_s // window_s):
                f["x_a"] += (1.0 - np.exp(-window_s / np.array(TAUS))) * (current_a - f["x_a"])
                arguments = state["anchors"], settings["anchors"], f, settings["filter"]
                found.append(detect_anchor(*arguments, float(window_s), current_a, voltage_v))
        return [int(kind) for kind in found if kind]


@pytest.mark.parametrize(
    "end",
    [
        pytest.param([TAIL, REST], id="at less than C/10"),
        pytest.param([(1200, -0.1, 4.2), REST], id="at C/10"),
        pytest.param([TAIL, (900, -0.02, 4.2), REST], id="at C/50"),
        pytest.param([TAIL, (300, 0.3, 4.1)], id="by a load"),
        pytest.param([(600, -0.08, 4.185), REST], id="with a voltage 0.4 % too low"),
        pytest.param([(3 * 3600, -0.04, 4.2)], id="never, below the tail current"),
    ],
)
def test_a_charge_that_ends_at_the_full_voltage_with_a_small_current_is_full(end: list[Phase]) -> None:
    assert Detector().kinds([CHARGE, *end]) == [FULL]


@pytest.mark.parametrize(
    "end",
    [
        pytest.param([(1200, -0.5, 4.2), REST], id="at C/2, as without a constant-voltage phase"),
        pytest.param([(600, -0.08, 4.1), REST], id="below the full voltage"),
        pytest.param([(10, -0.08, 4.2), REST], id="after 10 s"),
        pytest.param([(3 * 3600, -0.08, 4.2)], id="never, above the tail current"),
    ],
)
def test_another_end_of_a_charge_is_not_full(end: list[Phase]) -> None:
    assert Detector().kinds([CHARGE, *end]) == []


def test_regeneration_and_rests_of_a_full_pack_are_not_full() -> None:
    stop: list[Phase] = [(20, 0.0, 4.19), (30, 0.8, 4.1), (20, -0.1, 4.2)]
    assert Detector().kinds([(60, 0.0, 4.2), *60 * stop]) == []


def test_a_slow_source_detects_a_full_pack() -> None:
    assert Detector().kinds([CHARGE, TAIL, REST], window_s=30) == [FULL]


def test_a_charge_has_one_anchor_and_the_next_charge_another() -> None:
    detector = Detector()
    trickle: list[Phase] = 20 * [(3600, -0.02, 4.2), (60, 0.0, 4.19)]
    assert detector.kinds([CHARGE, TAIL, *trickle]) == [FULL]
    assert detector.kinds([(360, 0.1, 4.1), (600, -0.08, 4.2), REST]) == []  # only 1 % was drawn
    assert detector.kinds([(720, 0.5, 3.9), CHARGE, TAIL, REST]) == [FULL]


def test_a_gap_in_the_samples_discards_the_present_charge() -> None:
    detector = Detector()
    assert detector.kinds([CHARGE, TAIL]) == []
    assert detector.kinds([(600, 0.0, 4.17)], window_s=600) == []
    assert detector.kinds([REST]) == []


@pytest.mark.parametrize(
    ("gap_s", "current_c", "voltage_v", "kinds"),
    [
        pytest.param(200, -0.08, 4.2, [FULL], id="at the full voltage"),
        pytest.param(7200, -0.08, 4.2, [], id="hours apart"),
        pytest.param(200, -0.08, 4.1, [], id="below the full voltage"),
        pytest.param(200, -0.5, 4.2, [], id="with a large current"),
        pytest.param(200, 0.08, 4.2, [], id="of a discharge"),
    ],
)
def test_samples_some_minutes_apart_at_the_full_voltage_belong_to_one_charge(
    gap_s: int, current_c: float, voltage_v: float, kinds: list[int]
) -> None:
    detector = Detector()
    assert detector.kinds([CHARGE]) == []
    assert detector.kinds([(4 * gap_s, current_c, voltage_v)], window_s=gap_s) == []
    assert detector.kinds([REST]) == kinds


def test_a_configured_tail_current_limits_the_current_at_the_end() -> None:
    detector = Detector(limits=ChargeLimits(tail_current_a=0.02 * CAPACITY_AH))
    assert detector.kinds([CHARGE, TAIL, REST]) == []
    assert detector.kinds([CHARGE, TAIL, (600, -0.025, 4.2), REST]) == [FULL]


def test_a_protection_that_ends_a_discharge_at_the_cut_off_voltage_shows_an_empty_pack() -> None:
    detector = Detector()
    assert detector.kinds([(600, 0.2, 3.2), (30, 0.2, 2.5), (55, 0.0, 2.9)]) == []
    assert detector.kinds([(10, 0.0, 3.0), (3600, 0.0, 3.2)]) == [EMPTY]
    assert 0.03 < detector.estimator.record[0]["anchors"]["empty_std"] < 0.05


@pytest.mark.parametrize(
    "phases",
    [
        pytest.param([(30, 0.2, 2.5), (30, 0.0, 2.9), (5, 0.2, 2.6), (300, 0.0, 3.0)], id="a stop of 30 s"),
        pytest.param([(30, 0.2, 2.7), (300, 0.0, 3.0)], id="above the cut-off voltage"),
        pytest.param([(600, 0.2, 2.5), (30, -0.2, 3.0), (300, 0.0, 3.0)], id="a charge"),
    ],
)
def test_another_end_of_a_discharge_is_not_empty(phases: list[Phase]) -> None:
    assert Detector().kinds(phases) == []


def test_a_cold_pack_at_the_cut_off_voltage_is_not_empty() -> None:
    assert Detector(temperature_c=0.0).kinds([(600, 0.2, 2.5), (300, 0.0, 3.0)]) == []


def converged(soc: float, soc_std: float) -> Estimator:
    """Return an estimator whose filter has a single hypothesis, correlated with capacity, offset and OCV."""
    estimator = Estimator(load_cell("nmc", CAPACITY_AH), initial_soc=soc)
    estimator.step(0.0, 0.0, 4.0, temperature_c=25.0)
    f = estimator.record[0]["filter"]
    f["count"], f["best"] = 1, 0
    f["mean"][0, SOC], f["soc"], f["soc_std"] = soc, soc, soc_std
    covariance = f["covariance"][0]
    covariance[SOC] = covariance[:, SOC] = 0.0
    covariance[SOC, SOC] = soc_std**2
    for j in (LN_Q, OFFSET, NODE + 20):
        covariance[SOC, j] = covariance[j, SOC] = 0.5 * soc_std * np.sqrt(covariance[j, j])
    return estimator


def test_an_anchor_changes_neither_capacity_offset_nor_ocv_curve() -> None:
    estimator = converged(0.95, 0.05)
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    held = [LN_Q, OFFSET, *range(NODE, NODE + NODES)]
    mean, variances = f["mean"][0, held].copy(), np.diagonal(f["covariance"][0])[held].copy()
    for _ in range(50):
        apply_anchor(f, p, 1.0, 0.01)
    assert (f["mean"][0, held] == mean).all()
    assert np.diagonal(f["covariance"][0])[held] == pytest.approx(variances, rel=1e-12)
    assert f["soc"] == pytest.approx(1.0, abs=0.005)


def test_a_filter_with_a_wrong_and_certain_soc_restarts_at_the_anchor_without_its_bias() -> None:
    estimator = converged(0.8, 0.02)
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    f["mean"][0, B_SLOW] = 0.1
    apply_anchor(f, p, 1.0, 0.01)
    assert (f["soc"], f["soc_std"], f["mean"][0, B_SLOW]) == (1.0, pytest.approx(0.01), 0.0)
    assert np.linalg.eigvalsh(f["covariance"][0]).min() > -1e-12


def test_an_anchor_weights_the_hypotheses() -> None:
    estimator = Estimator(load_cell("lfp", CAPACITY_AH), initial_soc=0.6)
    estimator.step(0.0, 0.0, 3.3, temperature_c=25.0)
    f, p = estimator.record[0]["filter"], estimator.settings_record[0]["filter"]
    assert f["count"] > 1
    apply_anchor(f, p, 1.0, 0.01)
    assert f["count"] == 1
    assert f["soc"] == pytest.approx(1.0, abs=0.02)
