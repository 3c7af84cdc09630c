"""Available power and usable capacity of a pack in series whose cell voltages are measured."""

from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.forecast.available_power import PowerLimits, unknown_values
from bms_estimator.forecast.capability import write_capability
from bms_estimator.kernels.cells.records import ReadingFault
from bms_estimator.simulation.simulated_bank import BankCells
from tests.simulated_pack import CAPACITY_AH, CELLS, SimulatedPack

CUTOFF_V = 2.8 * CELLS
LIMITS = PowerLimits(1000.0, 1000.0)
DISCHARGE = "available_discharge_power_10s_w", "available_discharge_power_60s_w", "usable_capacity_ah"
CHARGE = "available_charge_power_10s_w", "available_charge_power_60s_w"


@pytest.fixture(scope="module")
def pack() -> SimulatedPack:
    """Return a pack after some hours of use."""
    pack = SimulatedPack(BankCells.random(np.random.default_rng(4), CELLS, CAPACITY_AH, 0.9))
    pack.run(4)
    return pack


def cells_with(pack: SimulatedPack, **values: float) -> CellDeviations:
    """Return deviations of equal cells, of which cell 2 has ``values``."""
    zero, one = np.zeros(CELLS), np.ones(CELLS)
    equal = CellDeviations(
        at_s=0.0,
        soc=np.full(CELLS, pack.estimator.soc),
        soc_std=zero,
        soc_deviation=zero,
        soc_deviation_std=zero,
        resistance_ratio=one,
        resistance_ratio_std=zero,
        capacity_ratio=one,
        self_discharge_a=zero,
        self_discharge_std_a=zero,
        fault=(ReadingFault.NONE,) * CELLS,
        reading_error_v=zero,
        contact_ohm=zero,
    )
    changed = {name: getattr(equal, name) + (np.arange(CELLS) == 1) * value for name, value in values.items()}
    return replace(equal, **changed)


def capability(pack: SimulatedPack, cells: CellDeviations | None) -> dict[str, float]:
    """Return available power and usable capacity by field name."""
    values = unknown_values()
    write_capability(values, pack.estimator, CUTOFF_V, LIMITS, 10.0, cells)
    return dict(zip(values.dtype.names, values[0].item(), strict=True))


def test_equal_cells_give_the_values_of_the_pack(pack: SimulatedPack) -> None:
    assert capability(pack, cells_with(pack)) == pytest.approx(capability(pack, None), nan_ok=True)


def test_an_emptier_cell_limits_the_discharge_but_not_the_charge(pack: SimulatedPack) -> None:
    without, limited = capability(pack, None), capability(pack, cells_with(pack, soc=-0.1, soc_deviation=-0.1))
    assert all(limited[name] < 0.99 * without[name] for name in DISCHARGE)
    assert limited["remaining_energy_wh"] < 0.99 * without["remaining_energy_wh"]
    assert all(limited[name] == without[name] for name in CHARGE)


def test_a_fuller_cell_limits_the_charge_but_not_the_discharge(pack: SimulatedPack) -> None:
    without, limited = capability(pack, None), capability(pack, cells_with(pack, soc=0.1, soc_deviation=0.1))
    assert all(limited[name] < 0.95 * without[name] for name in CHARGE)
    assert all(limited[name] == without[name] for name in DISCHARGE)


def test_a_cell_with_a_larger_resistance_limits_discharge_and_charge(pack: SimulatedPack) -> None:
    without, limited = capability(pack, None), capability(pack, cells_with(pack, resistance_ratio=0.5))
    assert all(limited[name] < 0.95 * without[name] for name in (*DISCHARGE[:2], *CHARGE))


def test_a_smaller_cell_limits_the_usable_capacity_in_proportion(pack: SimulatedPack) -> None:
    without, limited = capability(pack, None), capability(pack, cells_with(pack, capacity_ratio=-0.2))
    assert limited["usable_capacity_ah"] == pytest.approx(0.8 * without["usable_capacity_ah"], rel=0.03)
