"""Monitor of a bank: comparison of each discharge with reference discharges of the same bank, after each row."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.pack_model.bank_comparison import (
    MIN_REFERENCE_ROWS,
    MIN_ROWS,
    SINCE_EARLIER,
    SINCE_FIRST,
    ComparedCell,
    Comparison,
    Reference,
    ReferenceCurve,
)
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.pack_model.history import History, ReferenceDischarges, WeakCellTime
from bms_estimator.pack_model.open_circuit import drawn_soc, row_soc
from bms_estimator.settings.alarm_limits import WEAK_CELL_CLEAR_FRACTION, WEAK_CELL_STD

MIN_CHARGE_SOC = 0.05
"""Charge that ends a discharge, as a fraction of the capacity. A smaller charge counts as regeneration within the discharge."""
FIRST_ROWS, MAX_FIRST_ROWS = 4 * MIN_REFERENCE_ROWS, 8 * MIN_REFERENCE_ROWS
"""Minimum and maximum number of rows of the first discharges: about four and eight complete discharges."""


@dataclass(frozen=True)
class Discharge:
    """Present discharge, and the model with which its rows are compared."""

    start_s: float
    """Time of its first row [s]."""
    fit: PackFit
    """Fit from before the discharge. A later fit would absorb the weak cell."""
    references: list[Reference]
    """References from the earlier and the first discharges of the bank; those with too few rows are missing."""
    start_soc: float
    """SOC at its first row."""
    start_as: float
    """Charge counter at its first row [A s]."""

    def weakest(self, cell: CellCurves, rows: NDArray[np.void]) -> list[ComparedCell]:
        """Return an estimate of the weakest cell for each reference.

        The SOC of a row is the SOC at the start minus the charge drawn since.

        Args:
            cell: Curves of the cell file.
            rows: Rows of this discharge with a voltage, shape (n,), dtype HISTORY_ROW.
        """
        drawn_as = rows["charge_as"] - self.start_as
        return [
            Comparison(cell, each, rows, self.start_soc - drawn_soc(cell, each.fit, drawn_as)).weakest()
            for each in self.references
        ]


class BankMonitor:
    """Monitor of the weakest cell of one bank.

    A discharge that shows a weak cell replaces the result of an earlier discharge immediately. A discharge that shows no weak
    cell replaces it only when its SOC is as low as in the earlier discharge, because a weak cell is visible only near its empty
    end. Discharges with a weak cell do not become part of the reference.

    Args:
        cell: Curves of the cell file.

    Attributes:
        weakest: Present result; None before the first comparison.
    """

    def __init__(self, cell: CellCurves) -> None:
        self._cell = cell
        self.reset()

    def reset(self) -> None:
        """Discard all results, as for a new bank."""
        self.weakest: ComparedCell | None = None
        self._result_start_s = -np.inf  # time of the first row of the discharge that gave ``weakest`` [s]
        self._result_soc = np.inf  # SOC of the other cells at the last evaluated row of that discharge
        self._discharge: Discharge | None = None

    def add(self, history: History, new: int, fit: PackFit) -> None:
        """Evaluate the last ``new`` rows of a history, one by one. An exchange of the bank discards its results.

        Args:
            history: History of the bank; times of weak cells are added.
            new: Number of new rows.
            fit: Latest fit of the history.
        """
        if fit.is_exchanged and self._discharge is not None and self._discharge.fit.first_segment < fit.first_segment:
            self.reset()
            history.weak_cell_times.clear()
        if (
            fit.is_exchanged
            and history.first_discharges is not None
            and history.first_discharges.fit.first_segment < fit.first_segment
        ):
            history.first_discharges = None
        rows = history.rows[history.rows["segment"] >= fit.first_segment]
        for end in range(max(rows.size - new, 0) + 1, rows.size + 1):
            if is_discharge(rows[end - 1 : end]).all():
                self._evaluate(rows[:end], history, fit)

    def _evaluate(self, rows: NDArray[np.void], history: History, fit: PackFit) -> None:
        """Compare the discharge of the last row with its references. The largest deviation gives the result."""
        start = discharge_start(rows, MIN_CHARGE_SOC * self._cell.capacity_as)
        if self._discharge is None or self._discharge.start_s != rows["elapsed_s"][start]:
            self._discharge = self._new_discharge(rows, start, history, fit)
        discharge, measured = self._discharge, rows[start:][is_discharge(rows[start:])]
        if not discharge.references or measured.size < MIN_ROWS:
            return
        result = max(discharge.weakest(self._cell, measured), key=lambda each: each.deviation_std)
        self._update_result(result, history.weak_cell_times, discharge.start_s, float(rows["elapsed_s"][-1]))

    def _new_discharge(self, rows: NDArray[np.void], start: int, history: History, fit: PackFit) -> Discharge:
        """Return the discharge that begins with the row ``start``.

        While a cell is weak, the fit of the previous discharge is used, because the latest fit has absorbed the weak cell.
        """
        weak = history.weak_cell_times
        fit_before = self._discharge.fit if is_weak_now(weak) and self._discharge is not None else fit
        begin, earlier = rows[start : start + 1], reference_rows(rows[:start], weak)
        earlier["soc"] = row_soc(self._cell, fit_before, earlier)
        if history.first_discharges is None and earlier.size >= FIRST_ROWS:
            history.first_discharges = ReferenceDischarges(earlier[:MAX_FIRST_ROWS], fit_before)
        return Discharge(
            start_s=float(begin["elapsed_s"][0]),
            fit=fit_before,
            references=list(self._references(ReferenceDischarges(earlier, fit_before), history.first_discharges)),
            start_soc=float(row_soc(self._cell, fit, begin)[0]),
            start_as=float(begin["charge_as"][0]),
        )

    def _references(self, earlier: ReferenceDischarges, first: ReferenceDischarges | None) -> Iterator[Reference]:
        """Yield the references that have enough rows, from the earlier and the first discharges."""
        for each, change in ((earlier, SINCE_EARLIER), (first, SINCE_FIRST)):
            if each is None:
                continue
            curve = ReferenceCurve.of(self._cell, each.fit, each.rows, each.rows["soc"])
            if curve is not None:
                yield Reference(each.fit, curve, change)

    def _update_result(self, result: ComparedCell, weak: list[WeakCellTime], start_s: float, now_s: float) -> None:
        """Replace the present result by that of a discharge, and update the times of weak cells.

        A discharge is ignored unless it shows a weak cell, is as deep as the discharge of the present result, or is that
        discharge.

        Args:
            result: Result of the discharge.
            weak: Times with a weak cell; updated.
            start_s: Time of the first row of the discharge [s].
            now_s: Time of its last row [s].
        """
        was_weak, is_same = is_weak_now(weak), start_s == self._result_start_s
        is_weak = result.deviation_std >= WEAK_CELL_STD * (WEAK_CELL_CLEAR_FRACTION if was_weak else 1.0)
        if not (is_same or is_weak or result.soc <= (weak[-1].soc if was_weak else self._result_soc)):
            return
        if is_weak and not was_weak:
            weak.append(WeakCellTime(start_s, np.inf, result.soc))
        elif is_weak and not is_same:
            weak[-1] = weak[-1]._replace(soc=result.soc)
        elif was_weak and not is_weak:
            weak[-1] = weak[-1]._replace(end_s=now_s if is_same else start_s)
        self.weakest, self._result_start_s, self._result_soc = result, start_s, result.soc


def is_weak_now(weak: list[WeakCellTime]) -> bool:
    """Return True if a cell is weak at the end of the history."""
    return bool(weak) and np.isinf(weak[-1].end_s)


def reference_rows(rows: NDArray[np.void], weak: list[WeakCellTime]) -> NDArray[np.void]:
    """Return the rows of discharges, without those of the times with a weak cell."""
    is_reference = is_discharge(rows)
    for time in weak:
        is_reference &= (rows["elapsed_s"] < time.start_s) | (rows["elapsed_s"] >= time.end_s)
    return rows[is_reference]


def is_discharge(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return True for each row that belongs to a discharge and has a voltage."""
    return np.asarray((rows["direction"] > 0.0) & (rows["duration_s"] > 0.0))


def discharge_start(rows: NDArray[np.void], charged_as: float) -> int:
    """Return the index of the first row of the present discharge: the row with the lowest charge counter since the last charge.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        charged_as: Charge that ends a discharge [A s].
    """
    segment, charge_as = rows["segment"], rows["charge_as"]  # the counter increases on discharge
    start = rows.size - 1
    for j in range(rows.size - 1, -1, -1):
        if segment[j] != segment[-1] or charge_as[j] > charge_as[start] + charged_as:
            break
        if charge_as[j] <= charge_as[start]:
            start = j
    return start
