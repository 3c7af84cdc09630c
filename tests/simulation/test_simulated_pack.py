"""Simulated pack, which simulated boards measure."""

from bms_estimator.model.cell import load_cell
from bms_estimator.simulation.simulated_pack import FULL_SOC, PackWithRelay, SimulatedPack, constant


def test_charging_ends_at_the_full_soc_but_a_full_pack_can_be_discharged():
    cell = load_cell("chen_mora")
    # At 1C the last 1 % takes 36 s of the ten minutes.
    charged = SimulatedPack(cell, constant(-cell.cell.capacity_ah), soc=FULL_SOC - 0.01)
    currents_a = [charged(second).current_a for second in range(1, 601)]
    assert currents_a[0] < 0.0
    assert currents_a[-1] == 0.0
    assert FULL_SOC <= charged.soc < FULL_SOC + 0.001
    assert SimulatedPack(cell, constant(0.1), soc=1.0)(1.0).current_a == 0.1


def test_a_relay_connects_the_load_until_the_pack_is_empty():
    pack = PackWithRelay(load_cell("chen_mora"), 1.0, soc=0.01)
    assert pack(1.0).current_a == 0.0
    pack.is_connected = lambda: True
    assert pack(2.0).current_a == 1.0
    pack(60.0)  # 1 % of the capacity is 10 As
    assert pack(61.0).current_a == 0.0
