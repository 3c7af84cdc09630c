"""Std of the SOC that voltages leave after infinite time: ``make observability``.

A pack passes a window of SOC again and again. Every error that differs from pass to pass averages out. What remains is the
error of the cell file's OCV curve, and an error by direction (charge, discharge, rest) that recurs at each pass. The
unknowns are the SOC, the capacity, the hysteresis and the curve, with the priors of the slow fit. The model is linear in
small deviations:

    voltage error = slope (dSOC + (SOC - middle) d ln Q) + hysteresis + curve + error by direction

This std is a lower bound: no estimator that knows no more than the cell file can have a smaller error on average over the
possible cells and over the window. At single SOCs, as near full, the std may be smaller than this mean. Resistances are left out, because rests separate them: with their prior and currents of 0.4 C the std changes by
less than 0.01 %.
"""

import argparse
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves
from bms_estimator.pack_model.prior import (
    DIRECTION_CORRELATION_SOC,
    HYSTERESIS_STD,
    MIN_FULL_STD,
    NEW_SEGMENT_STD,
    curve_covariance,
)

CELLS = ("nmc", "nca", "lmo", "lfp", "ncr18650")
"""Generic cells, and the file of one real cell."""
LOWEST_SOCS = (0.12, 0.30, 0.50)
"""Lower ends of the windows of the table [SOC]."""
NOT_FULL_SOC = 0.95
"""Upper end of the window of a pack that is never full [SOC]."""
SOCS = (0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
"""SOCs of the table's columns."""
RATED_AH = 3.0
"""Capacity of the cells [Ah]. No result depends on it."""
DISCHARGE_C = 0.4
"""C-rate of a discharge whose charge is not seen. The offset of the current sensor is then an error of the capacity."""
LEARNED_CAPACITY_STD = 0.01
"""Std of a capacity that was measured."""
SOC, LN_Q, HYSTERESIS, CURVE = 0, 1, 2, 3
"""Positions of the unknowns; the curve's errors are the last ones."""
INFORMATIVE = 1.0
"""Information in units of the prior above which a direction counts for the rank: the std falls below 0.7 of the prior's."""


@dataclass(frozen=True)
class Window:
    """SOCs that a pack passes again and again, and what is known about it."""

    low: float
    high: float = NOT_FULL_SOC
    full: bool = False
    """True: the end of a charge is seen again and again. The window then ends at SOC 1."""
    charge_seen: bool = True
    capacity_std: float | None = None
    """Std of ln(true / declared capacity); None: that of the cell file."""

    @property
    def soc(self) -> Floats:
        """SOCs of the history's rows, evenly spaced."""
        high = 1.0 if self.full else self.high
        return np.linspace(self.low, high, max(round((high - self.low) / ROW_SOC), 1) + 1)


@dataclass(frozen=True)
class UnseenChange:
    """Common change of the unknowns that no voltage shows, of the size of one std of the result."""

    soc: float
    """Change of the SOC in the middle of the window."""
    ln_q: float
    curve_v: Floats
    """Change of the curve at the low end, the middle and the high end of the window [V]."""


class Observability:
    """Information of infinitely many passes of a window.

    Args:
        cell: Curves and prior of the cell.
        window: SOCs that the pack passes.
    """

    def __init__(self, cell: CellCurves, window: Window) -> None:
        self.cell, self.window, self.soc = cell, window, window.soc
        self.middle = 0.5 * (self.soc[0] + self.soc[-1])

    def prior(self) -> Floats:
        """Return the prior covariance of the unknowns."""
        capacity_std = self.cell.capacity_std if self.window.capacity_std is None else self.window.capacity_std
        offset_c = self.cell.offset_std_a / self.cell.one_c_a
        relative_offset = 0.0 if self.window.charge_seen else offset_c / DISCHARGE_C
        covariance = np.zeros((CURVE + self.soc.size,) * 2)
        covariance[SOC, SOC] = NEW_SEGMENT_STD**2
        covariance[LN_Q, LN_Q] = capacity_std**2 + relative_offset**2
        covariance[HYSTERESIS, HYSTERESIS] = 2.0 * HYSTERESIS_STD**2  # fast and slow part are both saturated
        covariance[CURVE:, CURVE:] = curve_covariance(self.cell, self.soc) + 1e-10 * np.eye(self.soc.size)
        return covariance

    def information(self) -> Floats:
        """Return the information on the unknowns: of discharge, rest and charge, and of the ends of charge."""
        distance = np.abs(self.soc[:, None] - self.soc)
        precision = np.linalg.inv(np.exp(-distance / DIRECTION_CORRELATION_SOC)) / self.cell.direction_std_v**2
        signs = (-1.0, -1.0, 1.0) if self.window.charge_seen else (-1.0, -1.0)
        slope_v = self.cell.slope(self.soc)
        half_v = np.interp(self.soc, SOC_GRID, self.cell.hysteresis_v)
        total = np.zeros((CURVE + self.soc.size,) * 2)
        for sign in signs:
            h = np.column_stack([slope_v, slope_v * (self.soc - self.middle), sign * half_v, np.eye(self.soc.size)])
            total += h.T @ precision @ h
        if self.window.full:
            at_full = self.soc_derivatives(np.ones(1))[0]
            total += np.outer(at_full, at_full) / MIN_FULL_STD**2
        return total

    def soc_derivatives(self, soc: Floats) -> Floats:
        """Return the derivatives of the SOC by the unknowns for each estimated SOC in ``soc``, shape (n, unknowns)."""
        rows = np.zeros((soc.size, CURVE + self.soc.size))
        rows[:, SOC], rows[:, LN_Q] = 1.0, soc - self.middle
        return rows

    @cached_property
    def spectrum(self) -> tuple[Floats, Floats]:
        """Information in units of the prior, ascending, and the directions that belong to it, as columns."""
        root = np.linalg.cholesky(self.prior())
        values, vectors = np.linalg.eigh(root.T @ self.information() @ root)
        return np.maximum(values, 0.0), root @ vectors

    @property
    def rank(self) -> int:
        """Number of directions about which the voltages tell more than the prior."""
        return int((self.spectrum[0] > INFORMATIVE).sum())

    def std(self, soc: Floats) -> Floats:
        """Return the std of the SOC for each estimated SOC in ``soc``."""
        values, vectors = self.spectrum
        return np.sqrt((self.soc_derivatives(soc) @ vectors) ** 2 @ (1.0 / (1.0 + values)))

    @property
    def capacity_std(self) -> float:
        """Std of ln(true / declared capacity)."""
        values, vectors = self.spectrum
        return float(np.sqrt(vectors[LN_Q] ** 2 @ (1.0 / (1.0 + values))))

    @property
    def mean_std(self) -> float:
        """Mean of the std over the window."""
        return float(self.std(self.soc).mean())

    def unseen_changes(self) -> tuple[UnseenChange, UnseenChange]:
        """Return one std of the SOC, and one std of the capacity at a given SOC.

        Each includes the changes of the other unknowns that are correlated with it.
        """
        values, vectors = self.spectrum
        covariance = vectors @ (vectors / (1.0 + values)).T
        shift = covariance[:, SOC] / np.sqrt(covariance[SOC, SOC])
        covariance -= np.outer(shift, shift)
        stretch = covariance[:, LN_Q] / np.sqrt(covariance[LN_Q, LN_Q])
        ends = CURVE + np.array([0, self.soc.size // 2, self.soc.size - 1])
        first, second = (UnseenChange(float(d[SOC]), float(d[LN_Q]), d[ends]) for d in (shift, stretch))
        return first, second


def curves(cell: CellModel) -> CellCurves:
    """Return the curves of a cell as the slow fit has them."""
    return CellCurves(Estimator(cell).settings_record[0]["filter"])


def bound(cell: CellCurves, window: tuple[float, float], *, full: bool) -> float:
    """Return the lower bound of the std of the SOC after infinite time, mean over a window.

    Args:
        cell: Curves and prior of the cell.
        window: Lowest and highest SOC that the pack passes.
        full: True: the ends of charges are seen.
    """
    return Observability(cell, Window(*window, full=full)).mean_std


def std_table(cells: list[str], windows: list[Window]) -> Table:
    """Return the std of the SOC for each cell and window [%]."""
    table = Table(title="lower bound of the std of the SOC after infinite time [%]")
    for column in ("cell", "window", "full seen", *(f"{soc:g}" for soc in SOCS), "mean", "capacity", "rank"):
        table.add_column(column, justify="right")
    for name in cells:
        cell = curves(load_cell(name, RATED_AH))
        for window in windows:
            table.add_row(name, *std_row(Observability(cell, window)))
    return table


def std_row(result: Observability) -> list[str]:
    """Return the cells of a row of the table, without the name. SOCs outside the window have a dash."""
    soc, stds = result.soc, result.std(np.array(SOCS))
    inside = [soc[0] <= at <= soc[-1] for at in SOCS]
    return [
        f"{soc[0]:.2f}-{soc[-1]:.2f}",
        "yes" if result.window.full else "no",
        *(f"{100.0 * std:.1f}" if is_inside else "-" for std, is_inside in zip(stds, inside, strict=True)),
        f"{100.0 * result.mean_std:.1f}",
        f"{100.0 * result.capacity_std:.1f}",
        f"{result.rank} of {result.soc.size + CURVE}",
    ]


def direction_table(cells: list[str], window: Window) -> Table:
    """Return the changes of SOC, capacity and curve that the voltages cannot tell from no change."""
    table = Table(
        title=f"changes that the voltages do not show, window {window.soc[0]:.2f}-{window.soc[-1]:.2f}, one std"
    )
    curve = (f"curve, {place} [mV]" for place in ("low", "middle", "high"))
    for column in ("cell", "SOC, middle [%]", "capacity [%]", *curve):
        table.add_column(column, justify="right")
    for name in cells:
        for d in Observability(curves(load_cell(name, RATED_AH)), window).unseen_changes():
            curve_mv = (f"{1e3 * volts:+.0f}" for volts in d.curve_v)
            table.add_row(name, f"{100.0 * d.soc:+.1f}", f"{100.0 * d.ln_q:+.1f}", *curve_mv)
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="make observability", description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="*", default=CELLS, help="names of cell files")
    parser.add_argument("--window", nargs=2, type=float, metavar=("LOW", "HIGH"), help="SOCs that the pack passes")
    parser.add_argument("--charge-unseen", action="store_true", help="the electronics are off while charging")
    parser.add_argument("--capacity-learned", action="store_true", help="the capacity is known to 1 %%")
    arguments = parser.parse_args()
    ends = [tuple(arguments.window)] if arguments.window else [(low, NOT_FULL_SOC) for low in LOWEST_SOCS]
    capacity_std = LEARNED_CAPACITY_STD if arguments.capacity_learned else None
    seen = not arguments.charge_unseen
    windows = [Window(low, high, full, seen, capacity_std) for low, high in ends for full in (False, True)]
    console = Console()
    console.print(std_table(arguments.cells, windows))
    console.print(direction_table(arguments.cells, windows[0]))


if __name__ == "__main__":
    main()
