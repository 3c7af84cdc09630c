"""Budget of processor time of each pack."""

import pytest

from bms_estimator.fleet.worker import block_runner
from bms_estimator.fleet.worker.block_runner import BURST_S, MAX_CHARGE_S, MAX_CPU_FRACTION, CpuBudget

CHARGES = round(BURST_S / MAX_CHARGE_S) + 1
"""Number of maximum charges that exhaust a budget."""


class ManualClock:
    """Clock that the test sets."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_only_the_pack_that_exhausted_its_budget_waits() -> None:
    clock = ManualClock()
    budget = CpuBudget(clock)
    for _ in range(CHARGES):
        assert not budget.is_exhausted("flood")
        budget.charge("flood", 100.0)  # counts as MAX_CHARGE_S
    assert budget.is_exhausted("flood")
    assert not budget.is_exhausted("honest")
    excess_s = CHARGES * MAX_CHARGE_S - BURST_S
    clock.now_s = excess_s / MAX_CPU_FRACTION + 0.1  # just after the budget has recovered
    assert not budget.is_exhausted("flood")


def test_source_at_1000_hz_stays_within_its_budget() -> None:
    clock = ManualClock()
    budget = CpuBudget(clock)
    for number in range(600):
        clock.now_s = 7.0 * number  # a block every 7 s
        assert not budget.is_exhausted("fast")
        budget.charge("fast", 0.035)  # 7,000 samples of 5 us each


def test_number_of_stored_packs_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_runner, "MAX_LEVELS", 10)
    clock = ManualClock()
    budget = CpuBudget(clock)
    for number in range(100):
        clock.now_s += 1.0
        budget.charge(f"p{number}", 0.01)
    # besides the limit, the pack that was charged last is stored
    assert len(budget._levels) <= block_runner.MAX_LEVELS + 1
