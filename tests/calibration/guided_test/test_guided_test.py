"""Guided test: recognition of each step by the samples, warnings, and control of a load by a relay."""

import functools

import numpy as np
import pytest

from bms_estimator.calibration.guided_test.guided_test import GuidedTest, Phase
from bms_estimator.calibration.guided_test.plan import LONG, SHORT, Limits
from bms_estimator.calibration.ocv.chen_mora_fit import Points
from bms_estimator.calibration.ocv.table_fit import fit_table
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import ocv_of_each
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell

LIMITS = Limits(
    capacity_ah=3.0,
    series_count=1,
    full_v=4.2,
    tail_a=0.15,
    cutoff_v=2.8,
    min_cell_v=2.8,
    max_cell_v=4.25,
    max_discharge_a=6.0,
    max_temperature_c=60.0,
)
STEP_S = 0.1 * 3.0 / 1.5 * 3600.0
"""Duration of a discharge of the short test at 1.5 A [s]."""


class Pack:
    """Source of samples with constant voltage and current, which it feeds to a guided test."""

    def __init__(self, plan=SHORT, *, relay=False):
        self.test, self.time_s = GuidedTest(plan, LIMITS, relay=relay), 0.0

    def run(self, seconds, current_a, voltage_v, temperature_c=25.0, period_s=1.0):
        samples = np.zeros(max(round(seconds / period_s), 1), dtype=SAMPLE)
        samples["time_s"] = self.time_s + period_s * np.arange(1, samples.size + 1)
        samples["current_a"], samples["voltage_v"] = current_a, voltage_v
        samples["temperature_c"] = temperature_c
        self.time_s = float(samples["time_s"][-1])
        self.test.feed(samples)
        return self.test

    def charge(self):
        self.run(600, -1.5, 4.0)
        self.run(60, -0.5, 4.2)
        return self.run(10, -0.1, 4.2)

    def until_first_discharge(self):
        self.charge()
        return self.run(SHORT.full_rest_s + 5, 0.0, 4.18)


def test_the_charge_ends_when_its_current_has_fallen_at_full_voltage() -> None:
    pack = Pack()
    assert pack.run(600, -1.5, 4.19).phase is Phase.CHARGE
    assert pack.run(10, -0.1, 4.2).phase is Phase.FULL_REST


def test_a_full_pack_at_rest_needs_no_charge() -> None:
    pack = Pack()
    assert pack.run(50, 0.0, 4.18).phase is Phase.CHARGE
    assert pack.run(20, 0.0, 4.18).phase is Phase.FULL_REST


def test_a_charge_that_ends_too_low_is_reported_with_the_remedy() -> None:
    pack = Pack()
    pack.run(600, -1.5, 4.0)
    test = pack.run(120, 0.0, 3.95)
    assert test.phase is Phase.CHARGE
    assert "ended at 3.95 V, below 4.20 V" in test.warning
    assert "pack.full_voltage_v" in test.warning


def test_discharges_and_rests_alternate_until_the_cut_off() -> None:
    pack = Pack()
    test = pack.until_first_discharge()
    phases = []
    for voltage_v in np.linspace(4.0, 3.2, 9):
        assert test.phase is Phase.DISCHARGE
        pack.run(STEP_S + 5, 1.5, voltage_v)
        phases.append(test.phase)
        pack.run(SHORT.rest_s + 5, 0.0, voltage_v + 0.1)
    assert set(phases) == {Phase.REST}
    pack.run(5, 1.5, 2.79)
    assert test.phase is Phase.REST
    assert pack.run(SHORT.rest_s + 5, 0.0, 3.1).phase is Phase.DONE
    assert len(test.points) == 11
    soc = [point.soc for point in test.points]
    assert soc == sorted(soc, reverse=True)
    assert soc[1] == pytest.approx(0.9, abs=0.005)


def test_the_load_of_a_relay_is_on_only_in_discharges() -> None:
    pack = Pack(relay=True)
    assert not pack.charge().load_on
    assert pack.run(SHORT.full_rest_s + 5, 0.0, 4.18).load_on
    test = pack.run(3, 1.5, 2.79)
    assert not test.load_on
    assert test.instruction == "The pack rests: nothing to do."


def test_a_relay_that_disconnects_an_empty_pack_at_once_ends_the_test() -> None:
    pack = Pack(relay=True)
    test = pack.until_first_discharge()
    for _ in range(10):
        pack.run(1, *((1.5, 2.79) if test.load_on else (0.0, 3.1)))
    assert test.phase is Phase.REST
    assert pack.run(SHORT.rest_s + 5, 0.0, 3.2).is_done


def test_a_single_low_mean_does_not_end_a_discharge() -> None:
    pack = Pack()
    pack.until_first_discharge()
    low = pack.run(1, 1.5, 2.79)
    assert (low.phase, low.warning) == (Phase.DISCHARGE, "")
    assert pack.run(5, 1.5, 3.9).phase is Phase.DISCHARGE


def test_a_load_that_stays_connected_to_an_empty_pack_is_reported() -> None:
    pack = Pack()
    pack.until_first_discharge()
    test = pack.run(5, 1.5, 2.79)
    assert test.phase is Phase.REST
    assert test.warning == "The pack is empty (2.79 V): remove the load now."


def test_a_charge_above_the_limit_of_the_cells_is_reported() -> None:
    assert "above the limit of the cells: end the charge now" in Pack().run(3, -1.5, 4.3).warning


def test_the_lowest_cell_ends_a_discharge() -> None:
    pack = Pack()
    pack.until_first_discharge()
    samples = np.zeros(6, dtype=SAMPLE)
    samples["time_s"] = pack.time_s + np.arange(1, 7)
    samples["current_a"], samples["voltage_v"] = 1.5, 3.6
    pack.test.feed(samples, np.tile([3.6, 2.75], (6, 1)))
    assert pack.test.phase is Phase.REST


def test_the_hottest_probe_is_compared_with_the_limit() -> None:
    samples = np.zeros(3, dtype=SAMPLE)
    samples["time_s"], samples["current_a"], samples["voltage_v"] = np.arange(3.0), 1.5, 3.9
    samples["temperature_c"], samples["temperature_max_c"] = 30.0, 75.0
    test = GuidedTest(SHORT, LIMITS)
    test.feed(samples)
    assert "The pack is at 75 °C" in test.warning


@pytest.mark.parametrize(("current_a", "temperature_c"), [(7.0, 25.0), (1.5, 61.0)])
def test_a_relay_disconnects_the_load_for_a_minute_after_a_limit_was_exceeded(current_a, temperature_c) -> None:
    pack = Pack(relay=True)
    pack.until_first_discharge()
    assert not pack.run(3, current_a, 3.9, temperature_c).load_on
    assert not pack.run(50, 0.0, 4.1).load_on
    assert pack.run(20, 0.0, 4.1).load_on


@pytest.mark.parametrize(
    ("current_a", "voltage_v", "message"),
    [
        (0.0, 4.1, "No current flows: connect the load."),
        (-1.0, 4.1, "charged at 1.00 A: disconnect the charger"),
        (0.2, 4.1, "only 0.20 A"),
        (7.0, 4.0, "more than 6.00 A: reduce it now"),
        (1.5, 4.0, ""),
    ],
)
def test_a_wrong_load_is_reported_in_a_discharge(current_a, voltage_v, message) -> None:
    pack = Pack()
    pack.until_first_discharge()
    warning = pack.run(3, current_a, voltage_v).warning
    assert message in warning if message else not warning


def test_a_current_in_a_rest_restarts_the_rest() -> None:
    pack = Pack()
    pack.until_first_discharge()
    pack.run(STEP_S + 5, 1.5, 3.9)
    pack.run(SHORT.rest_s - 60, 0.0, 4.0)
    assert "the rest begins again" in pack.run(10, 0.5, 3.9).warning
    assert pack.run(SHORT.rest_s - 60, 0.0, 4.0).phase is Phase.REST
    assert pack.run(70, 0.0, 4.0).phase is Phase.DISCHARGE


@pytest.mark.parametrize(
    ("gap_s", "seconds", "current_a", "reason"),
    [
        (0.0, 200, -1.5, "charged"),
        (600.0, 3, 1.5, "nothing was measured"),
    ],  # 10 minutes at 1.5 A are 8 % of the capacity
)
def test_an_unplanned_or_unmeasured_charge_restarts_the_test(gap_s, seconds, current_a, reason) -> None:
    pack = Pack()
    pack.until_first_discharge()
    pack.run(60, 1.5, 3.9)
    pack.time_s += gap_s
    test = pack.run(seconds, current_a, 3.9)
    assert test.phase is Phase.CHARGE
    assert reason in test.restart_reason
    assert test.points == []
    assert pack.charge().restart_reason == ""


def test_a_discharge_before_the_end_of_the_first_rest_restarts_the_test() -> None:
    pack = Pack()
    assert pack.charge().phase is Phase.FULL_REST
    test = pack.run(100, 1.5, 4.0)  # 1.4 % of the capacity
    assert test.phase is Phase.CHARGE
    assert "discharged before the rest of the full pack ended" in test.restart_reason


def test_a_gap_in_a_rest_does_not_interrupt_the_test() -> None:
    pack = Pack()
    pack.until_first_discharge()
    pack.run(STEP_S + 5, 1.5, 3.9)
    pack.run(10, 0.0, 4.0)
    pack.time_s += 7200.0
    assert pack.run(5, 0.0, 4.0).phase is Phase.DISCHARGE


def test_the_state_depends_only_on_the_samples() -> None:
    pack = Pack()
    pack.until_first_discharge()
    samples = np.zeros(3000, dtype=SAMPLE)
    samples["time_s"] = np.arange(1, 3001) * 0.5
    samples["current_a"], samples["voltage_v"] = -0.1, 4.2
    samples["current_a"][:20] = -1.0
    at_once, in_blocks = GuidedTest(SHORT, LIMITS), GuidedTest(SHORT, LIMITS)
    at_once.feed(samples)
    for block in np.array_split(samples, 77):
        in_blocks.feed(block)
    assert (at_once.phase, at_once.remaining_s, at_once.begin_s) == (
        in_blocks.phase,
        in_blocks.remaining_s,
        in_blocks.begin_s,
    )


@functools.cache
def socs_of_rests(plan):
    """Return the SOCs at which a pack rests in a test by a plan. They do not depend on the chemistry."""
    pack = Pack(plan)
    pack.charge()
    test = pack.run(plan.full_rest_s + 5, 0.0, 4.18)
    while not test.is_done and test.points[-1].soc > 0.1:
        pack.run(1, 1.5, 3.8)
        if test.phase is Phase.REST:
            pack.run(plan.rest_s + 5, 0.0, 3.9)
    return np.array(sorted({0.0, *(min(point.soc, 1.0) for point in test.points)}))


@pytest.mark.parametrize("plan", [SHORT, LONG], ids=lambda plan: plan.name)
@pytest.mark.parametrize("chemistry", ["lfp", "nca", "nmc", "lco", "lmo", "lto"])
def test_ocv_near_full_follows_from_the_rests_of_a_plan(plan, chemistry) -> None:
    rests = socs_of_rests(plan)
    grid = ocv_grid(load_cell(chemistry, 3.0))
    std_v = np.full(rests.size, 0.001)
    curve = fit_table(Points(rests, ocv_of_each(rests, *grid), std_v, std_v))
    near_full = np.linspace(0.9, 1.0, 101)
    assert np.abs(curve(near_full) - ocv_of_each(near_full, *grid)).max() < 0.025


def test_the_remaining_time_follows_the_measured_current() -> None:
    pack = Pack()
    test = pack.until_first_discharge()
    assert test.remaining_s == pytest.approx(2 * 3600 + 11 * SHORT.rest_s, rel=0.01)
    pack.run(60, 3.0, 3.8)
    assert test.remaining_s == pytest.approx(3600 + 11 * SHORT.rest_s, rel=0.03)
    assert "the measured 3.00 A" in test.remaining_basis


def test_a_guided_test_lasts_as_long_as_its_help_says() -> None:
    assert GuidedTest(SHORT, LIMITS).remaining_s / 3600 == pytest.approx(3.35)
    assert GuidedTest(LONG, LIMITS).remaining_s / 3600 == pytest.approx(13.5)


def test_noise_of_single_samples_does_not_interrupt_a_rest() -> None:
    pack = Pack()
    pack.charge()
    noise_a = 0.3 * np.random.default_rng(0).standard_normal(int(SHORT.full_rest_s + 5) * 100)
    assert pack.run(SHORT.full_rest_s + 5, noise_a, 4.18, period_s=0.01).phase is Phase.DISCHARGE
