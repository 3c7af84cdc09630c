"""Simulated bank: cells in series, each with its own capacity, SOC, resistance, temperature and internal short."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bms_estimator.estimator.filter_settings import filter_settings
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.bank_simulation import STATE, simulate
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.model.cell import CellModel
from bms_estimator.settings.observer import IdentifierSettings


@dataclass(frozen=True)
class BankCells:
    """Properties of the cells of a bank, each an array of shape (cells,)."""

    capacity_ah: Floats
    """True capacity [Ah]."""
    soc: Floats
    """SOC at time 0, at rest."""
    ohm_factor: Floats
    """Resistances relative to those of the cell file."""
    leak_ohm: Floats
    """Resistance of an internal short across the cell [ohm]; infinite without a short."""
    warmer_k: Floats
    """Temperature of the cell above that of the bank [K]."""

    @classmethod
    def equal(cls, cells: int, capacity_ah: float, soc: float = 1.0) -> Self:
        """Return equal cells with the resistances of the cell file."""
        ones = np.ones(cells)
        return cls(capacity_ah * ones, soc * ones, ones, np.inf * ones, 0.0 * ones)

    @classmethod
    def random(
        cls,
        rng: np.random.Generator,
        cells: int,
        capacity_ah: float,
        soc: float = 1.0,
        *,
        capacity_std: float = 0.015,
        soc_std: float = 0.01,
        ohm_std: float = 0.05,
    ) -> Self:
        """Return cells with normally distributed capacities, SOCs and resistances.

        Args:
            rng: Random generator.
            cells: Number of cells.
            capacity_ah: Mean capacity [Ah].
            soc: Mean SOC.
            capacity_std: Relative std of the capacities.
            soc_std: Std of the SOCs.
            ohm_std: Relative std of the resistances.
        """
        return cls(
            capacity_ah * np.exp(capacity_std * rng.standard_normal(cells)),
            np.clip(soc + soc_std * rng.standard_normal(cells), 0.0, 1.0),
            np.exp(ohm_std * rng.standard_normal(cells)),
            np.full(cells, np.inf),
            np.zeros(cells),
        )

    def with_weak_cell(self, cell: int, *, capacity_ratio: float = 1.0, soc_below: float = 0.0) -> Self:
        """Return the cells with one weak cell.

        Args:
            cell: Number of the weak cell, from 0.
            capacity_ratio: Factor on its capacity.
            soc_below: Amount subtracted from its SOC at time 0.
        """
        capacity_ah, soc = self.capacity_ah.copy(), self.soc.copy()
        capacity_ah[cell] *= capacity_ratio
        soc[cell] -= soc_below
        return replace(self, capacity_ah=capacity_ah, soc=soc)


@dataclass(frozen=True)
class BankHistory:
    """True values of a simulated bank at each of n times."""

    time_s: Floats
    """Time since the simulation began [s], shape (n,)."""
    current_a: Floats
    """Current that flowed [A], positive on discharge, shape (n,)."""
    cell_v: Floats
    """Voltage of each cell [V], shape (n, cells)."""
    cell_soc: Floats
    """SOC of each cell, negative after over-discharge, shape (n, cells)."""
    temperature_c: Floats
    """Temperature of the bank [degC], shape (n,)."""

    @property
    def voltage_v(self) -> Floats:
        """Voltage of the bank [V], shape (n,)."""
        return np.asarray(self.cell_v.sum(axis=1))

    def samples(self, rng: np.random.Generator, noise_v: float = 0.0, resolution_v: float = 1e-3) -> SampleBlock:
        """Return measured samples of the bank, dtype ``SAMPLE``.

        Args:
            rng: Random generator.
            noise_v: Std of a voltage sample [V].
            resolution_v: Resolution of a voltage sample [V].
        """
        block = np.zeros(self.time_s.size, SAMPLE)
        noisy_v = self.voltage_v + noise_v * rng.standard_normal(self.time_s.size)
        block["time_s"], block["current_a"], block["temperature_c"] = self.time_s, self.current_a, self.temperature_c
        block["voltage_v"] = np.round(noisy_v / resolution_v) * resolution_v
        return block


class SimulatedBank:
    """Bank that is simulated in one or more successive runs. Its cells have the RC pairs, OCV and hysteresis of a cell file.

    Args:
        cell: Cell model of one cell.
        cells: Properties of the cells.
        full_v: Voltage of the bank at which the charger limits the current [V]. The charge ends at the current ``TAPER_C``.
        cutoff_v: Voltage of the bank below which the load is disconnected until the next charge [V].

    Attributes:
        cells: Properties of the cells; may be replaced between two runs, for example to simulate aging. Their ``soc`` has no
            effect after the start.
        time_s: End of the last run [s].
    """

    def __init__(self, cell: CellModel, cells: BankCells, *, full_v: float = np.inf, cutoff_v: float = -np.inf) -> None:
        grid = ocv_grid(cell)
        self._settings = filter_settings(cell, grid, IdentifierSettings(), 1e-3, None)[0]
        self.cells, self.time_s = cells, 0.0
        self._limits_v = np.array([cutoff_v, full_v])
        self._state = np.zeros(cells.soc.size, STATE)
        self._state["soc"] = cells.soc
        self._stopped = np.zeros(1)  # direction of the current that a limit has switched off (``simulate``)

    @property
    def soc(self) -> Floats:
        """SOC of each cell."""
        return self._state["soc"].copy()

    def discharge_cell(self, cell: int, soc: float) -> None:
        """Subtract ``soc`` from the SOC of one cell, for example as the effect of an internal short."""
        self._state["soc"][cell] -= soc

    def run(self, current_a: Floats, step_s: float = 1.0, temperature_c: float | Floats = 25.0) -> BankHistory:
        """Simulate the bank with one requested current in each step.

        Args:
            current_a: Requested current [A], positive on discharge, shape (n,).
            step_s: Duration of a step [s].
            temperature_c: Temperature of the bank [degC], one value or one for each current.
        """
        n, c = current_a.size, self.cells
        flowed_a, bank_c = np.array(current_a, np.float64), np.full(n, temperature_c, np.float64)
        cell_v, cell_soc = np.empty((n, c.soc.size)), np.empty((n, c.soc.size))
        properties = np.array([3600.0 * c.capacity_ah, c.ohm_factor, c.leak_ohm, c.warmer_k])
        simulate(
            self._settings,
            self._state,
            properties,
            self._limits_v,
            self._stopped,
            step_s,
            bank_c,
            flowed_a,
            cell_v,
            cell_soc,
        )
        time_s = self.time_s + step_s * np.arange(n, dtype=np.float64)
        self.time_s += step_s * n
        return BankHistory(time_s, flowed_a, cell_v, cell_soc, bank_c)
