"""Figure 43 of the thesis: E_o of a simulated bank of three, healthy and with two weak batteries, with located dips."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.cell import CellModel
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.bank_comparison import MIN_ROWS, SINCE_EARLIER, Comparison, Reference, ReferenceCurve
from bms_estimator.pack_model.bank_monitor import is_discharge
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.open_circuit import OpenCircuit, fitted_ocv, row_soc
from bms_estimator.pack_model.saved import neutral_fit
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank

SERIES = 3
"""Number of batteries in the bank."""
WEAK_SOC = 0.85, 0.7
"""SOC of the two weak batteries at the start. The thesis does not print them."""
LOAD_C, STEP_S = 0.5, 2.0
"""Load as a C-rate, and interval between two samples [s]."""
NOISE_V, RESOLUTION_V = 2e-3, 1e-3
"""Std of the noise of a voltage sample, and resolution [V]."""
HEALTHY_DISCHARGES = 2
"""Number of discharges of the healthy bank that are the reference."""
MIN_DIP_DISTANCE = 0.1
"""Minimum distance of two dips, as a fraction of the capacity."""
MIN_VOLTAGE_V = 0.01
"""Voltage below which a sample of one battery is rejected [V]. A battery that is over-discharged to 0 V is no glitch here."""


@dataclass(frozen=True)
class BankDischarge:
    """E_o of the bank during a discharge at history rows."""

    drawn: Floats
    """Charge drawn, as a fraction of the capacity of one battery."""
    e_o_v: Floats
    """Measured voltage of the bank, corrected for the load [V]."""


class BankExperiment:
    """Simulated bank and the comparison of its faulty discharge with its healthy ones.

    Args:
        cell: Cell model of one battery.
    """

    def __init__(self, cell: CellModel) -> None:
        ratings = cell.cell.model_copy(update={"voltage_min_v": MIN_VOLTAGE_V})
        self._cell = cell = cell.model_copy(update={"cell": ratings})
        estimator = Estimator(cell.pack(SERIES, 1), voltage_resolution_v=RESOLUTION_V)
        self._curves = CellCurves(estimator.cell_file_settings)
        self._fit = neutral_fit()  # the batteries have the curves of the cell file

    @cached_property
    def healthy(self) -> BankDischarge:
        """Discharge of the healthy bank."""
        return self._e_o(self._healthy_rows[-1])

    @cached_property
    def faulty(self) -> BankDischarge:
        """Discharge of the bank with two weak batteries."""
        return self._e_o(self._faulty_rows)

    @cached_property
    def drawn_at_warning(self) -> float:
        """Charge drawn at which the comparison with the healthy discharges finds a weak battery."""
        rows, soc = self._faulty_rows, self._soc(self._faulty_rows)
        for end in range(MIN_ROWS, rows.size):
            weakest = Comparison(self._curves, self._reference, rows[:end], soc[:end]).weakest()
            if weakest.deviation_std >= WEAK_CELL_STD:
                return float(1.0 - soc[end - 1])
        return np.nan

    @cached_property
    def dips(self) -> list[float]:
        """Charge drawn at which E_o of the faulty bank falls fastest below the healthy one, for each weak battery."""
        lost_v = np.interp(self.faulty.drawn, self.healthy.drawn, self.healthy.e_o_v) - self.faulty.e_o_v
        drawn = self.faulty.drawn
        slope_v, middle = np.diff(lost_v) / np.diff(drawn), 0.5 * (drawn[1:] + drawn[:-1])
        found: list[float] = []
        for j in np.argsort(-slope_v).tolist():
            if len(found) < len(WEAK_SOC) and all(abs(middle[j] - other) > MIN_DIP_DISTANCE for other in found):
                found.append(float(middle[j]))
        return sorted(found)

    @cached_property
    def _healthy_rows(self) -> list[Records]:
        equal = BankCells.equal(SERIES, self._cell.cell.capacity_ah)
        return [self._discharge(equal, seed) for seed in range(HEALTHY_DISCHARGES)]

    @cached_property
    def _faulty_rows(self) -> Records:
        cells = BankCells.equal(SERIES, self._cell.cell.capacity_ah)
        soc = np.array([1.0, *WEAK_SOC])
        return self._discharge(replace(cells, soc=soc), seed=HEALTHY_DISCHARGES)

    @cached_property
    def _reference(self) -> Reference:
        """Reference of the healthy discharges."""
        rows = np.concatenate(self._healthy_rows)
        curve = ReferenceCurve.of(self._curves, self._fit, rows, row_soc(self._curves, self._fit, rows))
        if curve is None:
            raise RuntimeError("two complete discharges have too few rows for a reference")
        return Reference(self._fit, curve, SINCE_EARLIER)

    def _discharge(self, cells: BankCells, seed: int) -> Records:
        """Return the history rows of a complete discharge."""
        one_c = self._cell.cell.capacity_ah
        bank = SimulatedBank(self._cell, cells)
        history = bank.run(np.full(int(3600.0 / LOAD_C / STEP_S), LOAD_C * one_c), STEP_S)
        estimator = Estimator(self._cell.pack(SERIES, 1), voltage_resolution_v=RESOLUTION_V, initial_soc=1.0)
        recorder = SlowFit(estimator, interval_s=np.inf)
        Pack(estimator, recorder).run(history.samples(np.random.default_rng(seed), NOISE_V, RESOLUTION_V))
        rows = recorder.history.rows
        return rows[is_discharge(rows)]

    def _soc(self, rows: Records) -> Floats:
        """Return the SOC of a healthy bank that began full."""
        return np.asarray(1.0 - rows["charge_as"] / self._curves.capacity_as)

    def _e_o(self, rows: Records) -> BankDischarge:
        soc = self._soc(rows)
        measured = OpenCircuit.of(self._curves, self._fit, rows, soc)
        e_o_v = SERIES * (measured.error_v + fitted_ocv(self._curves, self._fit, soc))
        return BankDischarge(1.0 - soc, e_o_v)
