"""Bank without cell voltages, one cell of which becomes weak and is replaced: published values and alarm."""

from dataclasses import dataclass

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import NO_CELLS
from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model import slow_fit as slow_fit_module
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.simulated_bank import BankCells
from bms_estimator.sources.source import ReceivedSamples
from bms_estimator.telemetry.alarms.definitions import Change
from tests.pack_model.bank_cycles import ONE_C, cycle, new_bank
from tests.scripted_source import Collector, ScriptedSource

SERIES, STEP_S, BLOCK = 3, 5.0, 36
WEAK_CYCLE, REPLACED_CYCLE, CYCLES = 3, 4, 5
FIT_S = 12 * 3600.0


@dataclass
class Run:
    """Published values of all cycles."""

    published: list[tuple[int, Estimate, float]]
    """Cycle, estimate and true SOC of the weakest cell."""
    changes: list[tuple[int, Change]]
    """Cycle and change of the alarm ``weak_cell``."""


@pytest.fixture(scope="module")
def run() -> Run:
    now_s, number, rng, result, sink = 0.0, 0, np.random.default_rng(3), Run([], []), Collector()
    healthy = BankCells.random(rng, SERIES, ONE_C)
    bank, cell = new_bank(healthy), load_cell("ncr18650").pack(SERIES, 1)
    estimator = Estimator(cell)
    pack = Pack(estimator, SlowFit(estimator, interval_s=FIT_S))
    publisher = Publisher(
        Settings.model_validate({"publish": {"rate_hz": 0.1}}),
        pack,
        source=ScriptedSource(),
        sinks=[sink],
        clock=Clock(monotonic=lambda: now_s, wall=lambda: now_s),
        on_alarm=lambda change: result.changes.append((number, change)) if change.alarm.name == "weak_cell" else None,
    )
    for number in range(CYCLES):
        bank.cells = healthy.with_weak_cell(1, capacity_ratio=0.8) if number == WEAK_CYCLE else healthy
        for _, history in cycle(bank, rng, STEP_S):
            samples = history.samples(rng, noise_v=2e-3)
            for begin in range(0, samples.size, BLOCK):
                block = samples[begin : begin + BLOCK]
                now_s = float(block["time_s"][-1])
                publisher.add(ReceivedSamples(block, NO_CELLS), pack.run(block))
                if sink.snapshots and (estimate := sink.snapshots.pop().estimate):
                    true_soc = history.cell_soc[begin + block.size - 1].min()
                    result.published.append((number, estimate, max(float(true_soc), 0.0)))
    return result


@pytest.fixture(scope="module", autouse=True)
def _fewer_fits() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slow_fit_module, "MIN_INTERVAL_S", FIT_S)
        yield


def test_alarm_is_raised_in_the_discharge_of_the_weak_cell_and_ends_after_its_replacement(run: Run) -> None:
    assert [(number, change.alarm.active) for number, change in run.changes] == [
        (WEAK_CYCLE, True),
        (REPLACED_CYCLE, False),
    ]


def test_alarm_comes_before_the_weak_cell_is_empty(run: Run) -> None:
    raised_s = run.changes[0][1].at_s
    soc = [true_soc for _, estimate, true_soc in run.published if estimate.board_time_s <= raised_s]
    assert soc[-1] > 0.1


def test_weakest_cell_is_unknown_before_the_first_comparison(run: Run) -> None:
    first = run.published[0][1]
    assert first.weakest_cell_soc is None
    assert first.usable_capacity_to_weakest_ah is None


def test_published_soc_of_the_weak_cell_is_within_three_std(run: Run) -> None:
    raised_s = run.changes[0][1].at_s
    of_weak = [
        (estimate, true_soc)
        for number, estimate, true_soc in run.published
        if number == WEAK_CYCLE and estimate.board_time_s > raised_s and estimate.current_a > 0.0
    ]
    assert len(of_weak) > 20
    for estimate, true_soc in of_weak:
        assert estimate.weakest_cell_soc == pytest.approx(true_soc, abs=3.0 * estimate.weakest_cell_soc_std)


def test_capacity_of_the_weak_cell_and_the_charge_to_its_end_are_published(run: Run) -> None:
    raised_s = run.changes[0][1].at_s
    late = [e for number, e, _ in run.published if number == WEAK_CYCLE and e.board_time_s > raised_s][-1]
    assert late.weakest_cell_capacity == pytest.approx(0.8, abs=0.05)
    discharging = [
        (e.usable_capacity_to_weakest_ah, true_soc * 0.8 * ONE_C)
        for number, e, true_soc in run.published
        if number == WEAK_CYCLE and e.board_time_s > raised_s and e.current_a > 0.0
    ]
    usable_ah, true_ah = discharging[len(discharging) // 2]
    assert usable_ah == pytest.approx(true_ah, abs=0.1 * ONE_C)
