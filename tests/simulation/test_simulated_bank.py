import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank

CELL = load_cell("ncr18650")
CAPACITY_AH = CELL.cell.capacity_ah
EQUAL = BankCells.equal(3, CAPACITY_AH)


def discharge(cells: BankCells, seconds: int = 6500) -> SimulatedBank:
    bank = SimulatedBank(CELL, cells, cutoff_v=0.0)
    bank.run(np.full(seconds, 0.5 * CAPACITY_AH))
    return bank


def test_a_smaller_cell_is_empty_before_the_others() -> None:
    soc = discharge(EQUAL.with_weak_cell(1, capacity_ratio=0.9)).soc
    assert soc == pytest.approx([1.0 - 6500 / 7200, 1.0 - 6500 / 7200 / 0.9, 1.0 - 6500 / 7200])


def test_a_short_discharges_its_cell_at_rest() -> None:
    cells = BankCells.equal(2, CAPACITY_AH, soc=0.8)
    cells.leak_ohm[0] = 100.0
    bank = SimulatedBank(CELL, cells)
    bank.run(np.zeros(3600))
    lost_ah = (0.8 - bank.soc) * CAPACITY_AH
    assert lost_ah == pytest.approx([0.0398, 0.0], abs=5e-4)  # 4 V over 100 ohm


def test_the_charger_holds_the_voltage_of_the_bank_and_stops() -> None:
    bank = SimulatedBank(CELL, BankCells.equal(3, CAPACITY_AH, soc=0.5), full_v=12.6)
    history = bank.run(np.full(12000, -0.5 * CAPACITY_AH))
    assert history.voltage_v.max() == pytest.approx(12.6, abs=1e-3)
    assert history.current_a[-1] == 0.0


def test_equal_cells_are_a_pack_in_series() -> None:
    three = SimulatedBank(CELL, EQUAL).run(np.full(600, 1.5))
    one = SimulatedBank(CELL, BankCells.equal(1, CAPACITY_AH)).run(np.full(600, 1.5))
    assert three.voltage_v == pytest.approx(3.0 * one.voltage_v)


def test_a_warmer_cell_has_a_smaller_voltage_drop() -> None:
    cells = BankCells.equal(2, CAPACITY_AH, soc=0.5)
    cells.warmer_k[1] = 10.0
    cell_v = SimulatedBank(CELL, cells).run(np.full(60, 1.5), temperature_c=0.0).cell_v[-1]
    assert cell_v[1] > cell_v[0] + 0.01
