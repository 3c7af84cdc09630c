"""Residuals of the slow fit, their cost, and the normal equations of a Gauss-Newton step.

The cost is twice the negative log of the posterior density, up to a constant. It is the sum of squared residuals in
standard deviations. Huber's function limits the weight of large voltage residuals.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.kalman_filter.anchors import EMPTY, FULL
from bms_estimator.kernels.least_squares import add_residuals
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.intervals import Intervals, Links
from bms_estimator.pack_model.prediction import Prediction, Reference, VoltageModel
from bms_estimator.pack_model.prior import FULL_REPEAT_STD, Prior
from bms_estimator.pack_model.unknowns import Unknowns

HUBER = 3.0
"""Residual beyond which the cost of a voltage grows linearly, in std."""
FITTED_RMS, ZONES = 0.3, 10
"""RMS residual up to which the model fits the rows of one SOC zone and direction [std], and number of zones over SOC 0..1. Where
the model fits the pack, the RMS residual is 0.05 to 0.3."""
TOLERATED_EXCESS_SOC = 0.03
"""Tolerated distance of an SOC from the range 0..1. Assumed."""
EXCESS_STD_SOC = 0.01
"""Excess over ``TOLERATED_EXCESS_SOC`` that costs as much as a residual of 1 std [SOC]. Assumed."""


@dataclass(frozen=True)
class Block:
    """Residuals of one kind, with the non-zero derivatives of their predictions."""

    error: Floats
    """Measured minus predicted value, in std of the measurement, shape (n,)."""
    columns: NDArray[np.intp]
    """Indices of the unknowns, increasing in each row, shape (n, k)."""
    values: Floats
    """Derivatives of the prediction with respect to these unknowns, in std, shape (n, k)."""


@dataclass(frozen=True)
class Residuals:
    """Residuals of a history at ``x``, in std."""

    x: Floats
    """Unknowns."""
    cost: float
    """Cost of all residuals and of the prior."""
    prediction: Prediction
    """Predicted voltages."""
    voltage: Floats
    """Residual of each row's voltage."""
    links: Block
    """Residuals of the SOC at the start of each linked interval."""
    reference: Floats
    """Residual of each known SOC."""
    soc_excess: Floats
    """Excess of each row's SOC beyond its tolerated range."""


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations A x = b of a Gauss-Newton step x."""

    a: Floats
    """A. Only its lower triangle is valid."""
    b: Floats


class Equations:
    """Equations of one history.

    Args:
        cell: Curves of the cell file.
        rows: Shape (n,), dtype HISTORY_ROW, in order of time, at least one row.
        reference: Estimate at which the std of each row is computed.
    """

    def __init__(self, cell: CellCurves, rows: NDArray[np.void], reference: Reference) -> None:
        self.rows = rows
        self.intervals = Intervals(cell, rows)
        self.links = Links.of(cell, self.intervals)
        self.unknowns = Unknowns.of(self.intervals.count, self.intervals.segments)
        """Positions of the unknowns in their vector."""
        self.prior = Prior(cell, self.intervals, self.unknowns)
        self.model = VoltageModel(cell, self.intervals, self.unknowns, reference)
        self.voltage_v = rows["voltage_v"] / cell.series
        # the rows of one pass together have the weight of one row, because their errors are nearly equal
        self.weight = (rows["duration_s"] > 0.0) / np.sqrt(self.model.variance_v2 * self.intervals.rows_of_pass())
        """Inverse of the std of each row's voltage [1/V]; 0 for rows without a voltage."""
        self.known_rows = np.flatnonzero(np.isfinite(rows["reference_soc"]))
        self.known_soc: Floats = rows["reference_soc"][self.known_rows]
        kind = rows["reference_kind"][self.known_rows]
        self.is_full = kind == FULL
        std = np.where(self.is_full, FULL_REPEAT_STD, rows["reference_std"][self.known_rows])
        # all ends of discharge together have the weight of one, because they have the same error
        self.known_std = std * np.where(kind == EMPTY, math.sqrt(max(int((kind == EMPTY).sum()), 1)), 1.0)

    def weaken_misfits(self, r: Residuals) -> bool:
        """Lower the weight of the rows of each SOC zone and direction whose RMS residual exceeds ``FITTED_RMS``, by their ratio.

        A cell that the model cannot fit thereby gets a larger std, and the zones that the model fits determine the unknowns.

        Returns:
            True if a weight changed.
        """
        zone = (np.clip(r.prediction.soc, 0.0, 0.999) * ZONES).astype(np.intp)  # SOC 1 is in the last zone
        zone += ZONES * (self.rows["direction"] + 1.0).astype(np.intp)
        has_voltage = self.weight > 0.0
        rows = np.maximum(np.bincount(zone, has_voltage), 1)
        excess = np.sqrt(np.bincount(zone, r.voltage**2) / rows) / FITTED_RMS
        self.weight = self.weight / np.maximum(excess, 1.0)[zone]
        return bool((excess > 1.0).any())

    def residuals(self, x: Floats) -> Residuals:
        """Return residuals and cost at ``x``."""
        p = self.model.predict(x)
        voltage = self.weight * (self.voltage_v - p.voltage_v)
        reference = (self.known_soc - p.soc[self.known_rows] - self.is_full * x[self.unknowns.full]) / self.known_std
        soc_excess = (
            np.minimum(p.soc + TOLERATED_EXCESS_SOC, 0.0) + np.maximum(p.soc - 1.0 - TOLERATED_EXCESS_SOC, 0.0)
        ) / EXCESS_STD_SOC
        link_cost, links = self._link(x)
        deviation = x - self.prior.mean
        cost = huber_cost(voltage) + deviation @ self.prior.precision @ deviation
        cost += link_cost + reference @ reference + soc_excess @ soc_excess
        return Residuals(x, float(cost), p, voltage, links, reference, soc_excess)

    def normal_equations(self, r: Residuals, *, use_file_slope: bool = False) -> NormalEquations:
        """Return the normal equations at the unknowns of ``r``.

        Args:
            r: Residuals.
            use_file_slope: See ``VoltageModel.derivatives``.
        """
        precision = self.prior.precision
        a, b = precision.copy(), -precision @ (r.x - self.prior.mean)
        for block in (self._voltage_block(r, use_file_slope=use_file_slope), r.links, *self._soc_blocks(r)):
            add_residuals(a, b, block.columns, block.values, block.error)
        return NormalEquations(a, b)

    def _voltage_block(self, r: Residuals, *, use_file_slope: bool) -> Block:
        columns, values = self.model.derivatives(r.x, r.prediction, use_file_slope=use_file_slope)
        factor = huber_weight(r.voltage)
        return Block(factor * r.voltage, columns, (factor * self.weight)[:, None] * values)

    def _soc_blocks(self, r: Residuals) -> tuple[Block, Block]:
        """Return the blocks of known SOCs and of SOCs beyond their tolerated range."""
        columns, values = self.model.soc_derivatives(r.x)
        known_rows, excess_rows = self.known_rows, np.flatnonzero(r.soc_excess)
        known_columns = np.column_stack([columns[known_rows], np.full(known_rows.size, self.unknowns.full.start)])
        known_values = np.column_stack([values[known_rows], self.is_full]) / self.known_std[:, None]
        return (
            Block(r.reference, known_columns, known_values),
            Block(-r.soc_excess[excess_rows], columns[excess_rows], values[excess_rows] / EXCESS_STD_SOC),
        )

    def _link(self, x: Floats) -> tuple[float, Block]:
        """Return cost and residuals of the links: the SOC at the start of an interval, counted from the previous start.

        The SOC after a gap has the density of a mixture: normal about the counted SOC, and, with the probability of a hidden
        charge, uniform over 0..1 with a density of 1. The residual is weighted by the probability that no charge was hidden.
        """
        u, links = self.unknowns, self.links
        later, k = links.interval, links.interval - 1
        inverse_q = np.exp(-x[u.ln_q][k])
        drawn = (links.drawn_soc - x[u.offset][k] * links.hours) * inverse_q
        error = -(x[u.soc][later] - x[u.soc][k] + drawn) / links.std
        event = links.event_probability
        normal = (1.0 - event) * np.exp(-0.5 * error**2) / links.std / math.sqrt(2.0 * math.pi)
        is_gap = event > 0.0
        total = np.where(is_gap, normal + event, 1.0)
        cost = np.where(is_gap, -2.0 * np.log(total), error**2).sum()
        weight = np.where(is_gap, np.sqrt(normal / total), 1.0)
        columns = np.column_stack([u.soc.start + k, u.soc.start + later, u.offset.start + k, u.ln_q.start + k])
        values = np.column_stack([-np.ones(k.size), np.ones(k.size), -links.hours * inverse_q, -drawn])
        return float(cost), Block(weight * error, columns, (weight / links.std)[:, None] * values)


def huber_cost(residual: Floats) -> float:
    """Return the sum of Huber's function: the square of a small residual; a large residual counts linearly."""
    size = np.abs(residual)
    return float(np.where(size > HUBER, 2.0 * HUBER * size - HUBER**2, residual**2).sum())


def huber_weight(residual: Floats) -> Floats:
    """Return the factor on residuals and derivatives that makes the gradient of least squares equal that of Huber's cost."""
    weight: Floats = np.sqrt(HUBER / np.maximum(np.abs(residual), HUBER))
    return weight
