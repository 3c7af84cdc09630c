"""Estimators of single cells: accuracy, honesty of the std, blocks, missing voltages, saved state."""

import numpy as np
import pytest

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.protocols.base.reading_protocol import cell_block
from bms_estimator.simulation.simulated_bank import BankCells
from tests.benchmarks.cells import balanced_scores
from tests.simulated_pack import CAPACITY_AH, CELLS, SimulatedPack


@pytest.mark.parametrize("chemistry", ["nmc", "lfp"])
def test_deviations_of_the_soc_lie_within_three_std(chemistry: str) -> None:
    cells = BankCells.random(np.random.default_rng(4), CELLS, CAPACITY_AH, 0.9).with_weak_cell(1, capacity_ratio=0.85)
    pack = SimulatedPack(cells, chemistry)
    errors = []
    for _ in range(24):
        pack.run(1)
        estimate = pack.cells.deviations
        assert estimate
        true = pack.bank.soc - pack.bank.soc.mean()
        errors.append((estimate.soc_deviation - true) / estimate.soc_deviation_std)
    assert np.abs(errors).max() < 3.0
    assert estimate.capacity_ratio[1] == pytest.approx(0.85, abs=0.04)


def test_std_of_the_soc_is_larger_on_the_plateau_of_lfp() -> None:
    stds = {}
    for chemistry in ("nmc", "lfp"):
        pack = SimulatedPack(chemistry=chemistry)
        pack.run(4)
        assert pack.cells.deviations
        stds[chemistry] = pack.cells.deviations.soc_deviation_std.mean()
    assert stds["lfp"] > 2.0 * stds["nmc"]


def test_resistances_of_cells_are_found() -> None:
    cells = BankCells.random(np.random.default_rng(4), CELLS, CAPACITY_AH, 0.9, ohm_std=0.15)
    pack = SimulatedPack(cells)
    pack.run(6)
    assert pack.cells.deviations
    true = cells.ohm_factor / np.median(cells.ohm_factor)
    assert np.abs(pack.cells.deviations.resistance_ratio - true).max() < 0.06


def test_blocks_of_any_length_leave_the_same_state() -> None:
    pack = SimulatedPack()
    history = pack.bank.run(np.full(200, 5.0), 10.0)
    samples, states = history.samples(pack.rng), []
    for length in (1, 7, 200):
        estimator = Estimator(pack.model)
        cells = CellEstimator(estimator)
        for begin in range(0, samples.size, length):
            block = samples[begin : begin + length]
            cells.run(block, history.cell_v[begin : begin + length], estimator.run(block))
        states.append((cells.cells.tobytes(), cells.bank.tobytes()))
    assert states[0] == states[1] == states[2]


def test_a_rejected_sample_does_not_shift_the_cell_voltages() -> None:
    pack = SimulatedPack()
    history = pack.bank.run(np.full(200, 5.0), 10.0)
    samples = history.samples(pack.rng)
    spoiled = samples.copy()
    spoiled["voltage_v"][100] = np.nan
    spoiled_cells_v = history.cell_v.copy()
    spoiled_cells_v[100] = 1.0  # belongs to the rejected sample
    pack.cells.run(spoiled, spoiled_cells_v, pack.estimator.run(spoiled))
    assert pack.cells.deviations
    true = pack.bank.soc - pack.bank.soc.mean()
    assert np.abs(pack.cells.deviations.soc_deviation - true).max() < 0.02


def test_a_cell_without_a_reading_keeps_its_estimate() -> None:
    pack = SimulatedPack()
    pack.run(4)
    history = pack.bank.run(np.full(200, 5.0), 10.0)
    history.cell_v[:, 2] = np.nan
    pack.measure(history)
    assert pack.cells.deviations
    true = pack.bank.soc - pack.bank.soc.mean()
    assert np.abs(pack.cells.deviations.soc_deviation - true).max() < 0.02


def test_a_state_that_is_not_finite_starts_again() -> None:
    pack = SimulatedPack()
    pack.run(1)
    pack.cells.cells["covariance"][2] = np.nan
    pack.run(4)
    assert pack.cells.deviations
    true = pack.bank.soc - pack.bank.soc.mean()
    assert np.abs(pack.cells.deviations.soc_deviation - true).max() < 0.02


@pytest.mark.parametrize("cells", [2, 4])
def test_voltages_of_too_few_cells_give_no_estimate(cells: int) -> None:
    pack = SimulatedPack()
    history = pack.bank.run(np.full(50, 5.0), 10.0)
    samples = history.samples(pack.rng)
    pack.cells.run(samples, history.cell_v[:, :cells], pack.estimator.run(samples))
    assert pack.cells.deviations is None


def test_a_restored_estimator_has_the_saved_deviations() -> None:
    pack = SimulatedPack()
    pack.run(5)
    restored = CellEstimator(pack.estimator)
    assert restored.restore(pack.cells.saved_state, unseen_s=60.0) == ""
    assert pack.cells.deviations
    assert restored.deviations
    assert np.array_equal(restored.deviations.soc_deviation, pack.cells.deviations.soc_deviation)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("mean", np.nan, "a value is not finite"),
        ("mean", 20.0, "a deviation of a cell is implausible"),
        ("covariance", -1.0, "a variance is negative"),
        ("fault", 9, "a fault is unknown"),
    ],
)
def test_a_damaged_state_is_dropped_with_a_reason(field: str, value: float, reason: str) -> None:
    pack = SimulatedPack()
    pack.run(1)
    saved = pack.cells.saved_state
    saved["cells"][field][0] = value
    restored = CellEstimator(pack.estimator)
    assert restored.restore(saved, unseen_s=0.0) == reason
    assert restored.deviations is None


def test_the_state_of_a_pack_with_another_number_of_cells_is_dropped_with_a_reason() -> None:
    pack = SimulatedPack()
    pack.run(1)
    other = CellEstimator(Estimator(load_cell("nmc", CAPACITY_AH).pack(4, 1)))
    assert other.restore(pack.cells.saved_state, 0.0) == "it has 6 cells, and the pack has 4 in series"


def test_a_short_of_a_stored_pack_is_found_after_a_gap() -> None:
    """The pack rests for a month while the service is off."""
    pack = SimulatedPack()
    pack.run(12)
    pack.short(2, 1000.0)
    pack.bank.run(np.zeros(720), 3600.0)
    pack.short(2, np.inf)
    pack.estimator.resume(30 * 86400.0)
    pack.cells.resume(30 * 86400.0)
    pack.run(6)
    assert pack.cells.deviations
    true = pack.bank.soc - pack.bank.soc.mean()
    assert np.abs(pack.cells.deviations.soc_deviation - true).max() < 0.05


def test_a_healthy_pack_of_lfp_that_is_charged_to_full_has_no_self_discharge() -> None:
    """The fullest cell leaves the others by hundreds of millivolts, and returns when the discharge begins."""
    assert balanced_scores("lfp", 102, 0.0, highest=True).max() == 0.0


def test_samples_without_all_cells_leave_the_same_state_live_and_in_a_replay() -> None:
    """A BMS reports 3 cells, then 8 slots for 6 cells, then none. The decoder of a replay fills a block up to 8 slots."""
    states = []
    for length in (1, 90):
        pack, slots = SimulatedPack(), CellSlots(6)
        history = pack.bank.run(np.full(90, 5.0), 10.0)
        samples = history.samples(pack.rng)
        rows = [row.tolist() for row in history.cell_v]
        rows[:20], rows[60:] = [row[:3] for row in rows[:20]], [[]] * 30
        rows[20:60] = [[*row, 0.0, 0.0] for row in rows[20:60]]
        for first in range(0, 90, length):
            part = slice(first, first + length)
            pack.cells.run(samples[part], slots.select(cell_block(rows[part])), pack.estimator.run(samples[part]))
        assert pack.cells.bank["windows"][0] > 0
        states.append(pack.cells.cells.tobytes() + pack.cells.bank.tobytes())
    assert states[0] == states[1]
