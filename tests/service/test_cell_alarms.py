"""Faults of single cells and of their readings: published values and alarms, raised and cleared."""

import numpy as np
import pytest

from bms_estimator.simulation.simulated_bank import BankCells
from tests.simulated_pack import CAPACITY_AH, CELLS, SimulatedPack, Wiring, stuck, with_contact, with_offset


@pytest.fixture(scope="module")
def shorted() -> SimulatedPack:
    """Pack with a short of 20 ohm across cell 3, for half a day."""
    pack = SimulatedPack()
    pack.run(5)
    pack.short(2, 20.0)
    pack.run(12)
    return pack


def test_a_short_raises_its_alarm_and_names_the_cell(shorted: SimulatedPack) -> None:
    assert shorted.transitions("cell_short")[:1] == [True]
    raised = next(change.alarm for change in shorted.changes if change.alarm.name == "cell_short")
    assert raised.severity == "critical"
    assert "cell 3 discharges itself" in raised.text
    assert shorted.transitions("cell_sensor_fault") == []


def test_a_short_is_published_with_its_current(shorted: SimulatedPack) -> None:
    cells = shorted.published.cells
    assert cells
    assert cells.weakest == 3
    assert [cell.fault for cell in cells.cells] == [None, None, "internal short", None, None, None]
    assert cells.cells[2].self_discharge_a == pytest.approx(3.8 / 20.0, rel=0.5)


def test_the_alarm_of_a_short_is_cleared_after_the_short_is_gone(shorted: SimulatedPack) -> None:
    shorted.short(2, np.inf)
    shorted.run(8)
    assert shorted.transitions("cell_short") == [True, False]


@pytest.mark.parametrize(
    ("wiring", "faults", "text"),
    [
        (with_contact(2, 0.008), {3: "contact"}, "a contact of cell 3 has a resistance of"),
        (with_offset({3: 0.03}), {4: "wrong reading"}, "the reading of cell 4 is wrong by 30 mV"),
        (with_offset({3: 0.03, 4: -0.03}), {4: "sense wire", 5: "sense wire"}, "the sense wire between them is faulty"),
        (stuck(1), {2: "stuck reading"}, "the reading of cell 2 does not respond to the load"),
    ],
    ids=["contact", "offset", "sense wire", "stuck"],
)
def test_a_faulty_reading_is_told_from_a_faulty_cell(wiring: Wiring, faults: dict[int, str], text: str) -> None:
    pack = SimulatedPack()
    pack.run(3)
    pack.run(2, wiring)
    assert pack.published.cells
    assert {cell.number: cell.fault for cell in pack.published.cells.cells if cell.fault} == faults
    assert text in next(alarm.text for alarm in pack.published.alarms if alarm.name == "cell_sensor_fault")
    pack.run(2)
    assert pack.transitions("cell_sensor_fault") == [True, False]
    assert pack.transitions("cell_short") == []


@pytest.mark.parametrize("chemistry", ["nmc", "lfp"])
def test_a_healthy_pack_raises_no_alarm_of_its_cells(chemistry: str) -> None:
    pack = SimulatedPack(chemistry=chemistry, seed=2)
    pack.run(30)
    assert pack.transitions("cell_short") == pack.transitions("cell_sensor_fault") == []


def test_a_balancer_that_drains_the_highest_cell_raises_no_alarm_of_a_short() -> None:
    """A balancer drains the highest cell with C/200 while the pack is nearly full."""
    pack = SimulatedPack(BankCells.random(np.random.default_rng(5), CELLS, CAPACITY_AH, 0.9, soc_std=0.03))
    pack.run(3)
    discharge_a = CAPACITY_AH * 0.2
    for _ in range(6):
        pack.measure(pack.bank.run(np.full(360, -discharge_a), 10.0))
        while pack.bank.soc.mean() < 0.9:
            pack.measure(pack.bank.run(np.full(60, -discharge_a), 10.0))
        highest = int(np.argmax(pack.bank.soc))
        pack.short(highest, 4.1 / (CAPACITY_AH / 200.0))
        pack.measure(pack.bank.run(np.full(360, -0.01 * discharge_a), 10.0))
        pack.short(highest, np.inf)
        pack.measure(pack.bank.run(np.full(720, discharge_a), 10.0))
    assert pack.transitions("cell_short") == []


def test_weakest_cell_is_published_with_its_spread(shorted: SimulatedPack) -> None:
    estimate = shorted.published.estimate
    assert estimate
    assert estimate.weakest_cell == 3
    assert estimate.weakest_cell_soc == pytest.approx(
        max(float(shorted.bank.soc.min()), 0.0), abs=3.0 * (estimate.weakest_cell_soc_std or 0.0)
    )
    assert estimate.weakest_cell_capacity == pytest.approx(1.0, abs=0.1)
    empty_ah = float(shorted.bank.soc.min()) * CAPACITY_AH
    assert estimate.usable_capacity_to_weakest_ah == pytest.approx(empty_ah, abs=0.1 * CAPACITY_AH)
    assert estimate.cell_soc_spread
    assert estimate.cell_soc_spread == pytest.approx(float(np.ptp(shorted.bank.soc)), abs=0.03)
