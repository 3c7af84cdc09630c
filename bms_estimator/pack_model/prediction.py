"""Predicted voltage of each history row, with its variance and its derivatives by the unknowns x.

    v = OCV(z, T) + error of the OCV(z) + hysteresis - sum of scaled resistances times currents + error by direction
    z = SOC at the start of the interval - (charge - offset t) / (capacity)

All voltages are of one cell. docs/theory/pack-model.md has the complete equations.

An error that repeats whenever the pack passes an SOC in one direction is one unknown, the error by direction. More passes
therefore do not lower the std of the curve below the std of this error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HYSTERESIS_SOC, ROW_SOC
from bms_estimator.kernels.cell_model.rc_ladder import HYSTERESIS_J, REFERENCE_C, STRONG_J, TAUS, WEAK_J
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.aging import RESISTANCE, AgingVariance
from bms_estimator.pack_model.cell_curves import SOC_GRID, CellCurves, NodePosition, arrhenius
from bms_estimator.pack_model.intervals import Intervals
from bms_estimator.pack_model.prior import variance_between_nodes
from bms_estimator.pack_model.unknowns import (
    CURVE_NODES,
    DIRECTION_NODES,
    RESISTANCE_GROUPS,
    SCALES,
    SHAPE_NODES,
    Unknowns,
)

PASS_FRACTION = 0.75
"""Std of the part of the overpotential's error that differs from pass to pass, as a fraction of the std of the part that
repeats (``CellCurves.drop_std``)."""
COUNT_STD_SOC = 0.004
"""Std of the SOC of a row due to counting [SOC]."""
KNEE_STD_SOC, KNEE_WIDTH_SOC = 0.015, 0.12
"""Std of the position of the OCV's knee near empty, and SOC over which it decays [SOC]. Without this std, a slow first charge
from empty gave an SOC 6 to 8 % wrong, because errors of offset, capacity and knee have equal effects on the voltage."""
EMPTY_RELATIVE, EMPTY_WIDTH_SOC = 0.4, 0.04
"""Relative std of the overpotential at SOC 0, and SOC over which it decays. Both are assumed, because resistances near empty
depend on the cell and on the load."""
START_LOAD_C = 0.6
"""Std of the load before the RC pairs were reset, as a C-rate. Assumed."""
GROUP_STARTS = [RESISTANCE_GROUPS.index(group) for group in range(SCALES)]
"""First resistance of each group."""

Derivatives = tuple[NDArray[np.intp], Floats]
"""Non-zero derivatives of n values by the unknowns: indices of the unknowns and derivatives, both of shape (n, k)."""


@dataclass(frozen=True)
class Prediction:
    """Predicted voltages of n rows, and their terms."""

    voltage_v: Floats
    """Predicted voltage [V]."""
    soc: Floats
    """SOC z."""
    ohm: Floats
    """Resistances of the cell file at z and T, shape (n, RESISTANCES) [ohm]."""
    scale: Floats
    """Factor on the resistances of each group, shape (n, SCALES)."""
    drops_v: Floats
    """Voltage drop over the resistances of each group, positive on discharge, shape (n, SCALES) [V]."""
    drop_v: Floats
    """Overpotential: sum of ``drops_v`` [V]."""
    hysteresis_v: Floats
    """M: half of the difference of the OCV after charge and after discharge [V]."""
    h: Floats
    """Fast and slow part of the hysteresis, -1..1, shape (n, 2)."""
    shape_at: NodePosition
    """Position of z on the nodes of the resistances' error."""
    curve_at: NodePosition
    """Position of z on the nodes of the OCV's error."""
    direction_at: NodePosition
    """Position of z on the nodes of the error by direction."""


@dataclass(frozen=True)
class Reference:
    """Estimate of SOC and resistances at which the std of each row is computed.

    If the std depended on the unknowns, the fit would prefer SOCs and resistances with a large std.
    """

    soc: Floats
    """SOC of each row."""
    ln_r: Floats
    """ln of the true over the file's resistances of each group, shape (SCALES,)."""


class VoltageModel:
    """Model of the voltages of one history. Its attributes are computed once, because they do not depend on the unknowns.

    Args:
        cell: Curves of the cell file.
        intervals: Intervals of the history.
        u: Positions of the unknowns.
        reference: Estimate at which the std of each row is computed.
    """

    def __init__(self, cell: CellCurves, intervals: Intervals, u: Unknowns, reference: Reference) -> None:
        self.cell, self.u, self.intervals = cell, u, intervals
        rows = intervals.rows
        temperature_c: Floats = rows["temperature_c"]
        self.above_25_c_k: Floats = temperature_c - REFERENCE_C
        self.weak, self.strong = arrhenius(WEAK_J, temperature_c), arrhenius(STRONG_J, temperature_c)
        self.hysteresis_factor = arrhenius(HYSTERESIS_J, temperature_c)
        self.current_a = np.column_stack([rows["current_a"], rows["x_a"]])
        self.counted_h: Floats = rows["hysteresis"]
        # the hysteresis at the start of the segment, an unknown, decays with the throughput
        self.start_h_decay = np.exp(-rows["throughput_soc"][:, None] / np.array(HYSTERESIS_SOC))
        self.start_h_at = u.start_hysteresis.start + 2 * intervals.segment
        # currents that the RC pairs keep from a load of one std before their reset; the load is an unknown
        self.start_load_a = START_LOAD_C * cell.one_c_a * kept_fraction(rows)
        self.start_load_at = u.start_load.start + intervals.segment
        self.aging_trend = AgingVariance(RESISTANCE, cell, intervals).trend[intervals.of_row]
        direction = (rows["direction"] + 1.0).astype(np.intp)
        self.direction_start = u.direction.start + direction * DIRECTION_NODES
        z = np.clip(reference.soc, 0.0, 1.0)
        ohm = cell.resistances(z, self.weak, self.strong)
        drop_v = by_group(ohm * self.current_a) @ np.exp(reference.ln_r)
        self.direction_v = np.sqrt(
            cell.direction_std_v**2 + (cell.drop_std * drop_v) ** 2 + variance_between_nodes(cell, z)
        )
        """Std of the error by direction [V]."""
        scaled_ohm = ohm * np.exp(reference.ln_r)[np.array(RESISTANCE_GROUPS)]
        self.variance_v2 = self._variance(z, drop_v) + by_sampling(rows, scaled_ohm)
        """Variance of each row's voltage about its prediction [V^2]."""

    def _variance(self, z: Floats, drop_v: Floats) -> Floats:
        """Return the variance of each row's voltage about its prediction [V^2]."""
        near_empty, at_empty = np.exp(-((z / KNEE_WIDTH_SOC) ** 2)), np.exp(-((z / EMPTY_WIDTH_SOC) ** 2))
        cell = self.cell
        by_pass_v2 = (
            cell.direction_std_v**2
            + (PASS_FRACTION * cell.drop_std * drop_v) ** 2
            + (EMPTY_RELATIVE * at_empty * drop_v) ** 2
        )
        by_soc_v2 = (cell.slope(z) * (COUNT_STD_SOC + KNEE_STD_SOC * near_empty)) ** 2
        return np.asarray(by_pass_v2 + by_soc_v2)

    def soc(self, x: Floats) -> Floats:
        """Return the SOC of each row."""
        u, k = self.u, self.intervals.of_row
        return np.asarray(x[u.soc][k] - self._drawn_soc(x) * np.exp(-x[u.ln_q][k]))

    def soc_derivatives(self, x: Floats) -> Derivatives:
        """Return the derivatives of the SOC of each row by SOC, offset and ln of the capacity of its interval."""
        u, k = self.u, self.intervals.of_row
        inverse_q = np.exp(-x[u.ln_q][k])
        at = np.column_stack([u.soc.start + k, u.offset.start + k, u.ln_q.start + k])
        return at, np.column_stack([np.ones(k.size), self.intervals.hours * inverse_q, self._drawn_soc(x) * inverse_q])

    def _drawn_soc(self, x: Floats) -> Floats:
        """Return the true charge since the interval's start, as a fraction of the declared capacity."""
        offset: Floats = x[self.u.offset][self.intervals.of_row]
        return self.intervals.drawn_soc - offset * self.intervals.hours

    def predict(self, x: Floats) -> Prediction:
        """Return the predicted voltages."""
        return self._predict_at(x, self.soc(x))

    def _predict_at(self, x: Floats, z: Floats) -> Prediction:
        """Return the voltages that ``x`` predicts if the rows' SOCs are ``z``."""
        u, cell = self.u, self.cell
        shape_at, curve_at = NodePosition.of(z, SHAPE_NODES), NodePosition.of(z, CURVE_NODES)
        direction_at = NodePosition.of(z, DIRECTION_NODES)
        ohm = cell.resistances(z, self.weak, self.strong)
        ln_shape = shape_at.interpolate(x[u.shape]) + x[u.arrhenius] * self.above_25_c_k + x[u.aging] * self.aging_trend
        scale = np.exp(x[u.ln_r] + ln_shape[:, None])
        true_a = self.current_a - (x[u.offset][self.intervals.of_row] * cell.one_c_a)[:, None]
        true_a += x[self.start_load_at][:, None] * self.start_load_a
        drops_v = scale * by_group(ohm * true_a)
        drop_v = drops_v.sum(axis=1)
        hysteresis_v = self.hysteresis_factor * np.interp(z, SOC_GRID, cell.hysteresis_v)
        h = self.counted_h + self.start_h_decay * np.column_stack([x[self.start_h_at], x[self.start_h_at + 1]])
        ocv_v = cell.ocv(z) + curve_at.interpolate(x[u.curve])
        ocv_v += self.above_25_c_k * (x[u.entropy] + np.interp(z, SOC_GRID, cell.per_kelvin_v))
        by_direction_v = self.direction_v * direction_at.interpolate(x, self.direction_start)
        return Prediction(
            voltage_v=ocv_v - drop_v + hysteresis_v * (h @ x[u.hysteresis]) + by_direction_v,
            soc=z,
            ohm=ohm,
            scale=scale,
            drops_v=drops_v,
            drop_v=drop_v,
            hysteresis_v=hysteresis_v,
            h=h,
            shape_at=shape_at,
            curve_at=curve_at,
            direction_at=direction_at,
        )

    def derivatives(self, x: Floats, p: Prediction, *, use_file_slope: bool) -> Derivatives:
        """Return the derivatives of the predicted voltages.

        Args:
            x: Unknowns.
            p: Prediction at ``x``.
            use_file_slope: True: the derivative by SOC is the slope of the cell file's OCV, for the covariance. The fitted
                correction is rough, and its slopes would count as information on the SOC.
        """
        u, n, m = self.u, p.soc.size, x[self.u.hysteresis]
        soc_columns, by_soc = self._derivatives_by_soc(x, p, use_file_slope=use_file_slope)
        shape_low, shape_high = p.shape_at.weights
        curve_low, curve_high = p.curve_at.weights
        direction_low, direction_high = p.direction_at.weights
        by_start_load = -(p.scale * by_group(p.ohm * self.start_load_a)).sum(axis=1)
        by_start_h = p.hysteresis_v[:, None] * m * self.start_h_decay
        direction_at = self.direction_start + p.direction_at.below
        terms = [
            *zip(soc_columns.T, by_soc.T, strict=True),
            *((np.full(n, u.ln_r.start + j), -p.drops_v[:, j]) for j in range(SCALES)),
            (np.full(n, u.aging.start), -self.aging_trend * p.drop_v),
            (u.shape.start + p.shape_at.below, -shape_low * p.drop_v),
            (u.shape.start + p.shape_at.below + 1, -shape_high * p.drop_v),
            *((np.full(n, u.hysteresis.start + j), p.hysteresis_v * p.h[:, j]) for j in range(2)),
            *((self.start_h_at + j, by_start_h[:, j]) for j in range(2)),
            (self.start_load_at, by_start_load),
            (np.full(n, u.entropy.start), self.above_25_c_k),
            (np.full(n, u.arrhenius.start), -self.above_25_c_k * p.drop_v),
            (u.curve.start + p.curve_at.below, curve_low),
            (u.curve.start + p.curve_at.below + 1, curve_high),
            (direction_at, self.direction_v * direction_low),
            (direction_at + 1, self.direction_v * direction_high),
        ]
        columns, values = zip(*terms, strict=True)
        return np.column_stack(columns), np.column_stack(values)

    def _derivatives_by_soc(self, x: Floats, p: Prediction, *, use_file_slope: bool) -> Derivatives:
        """Return the derivatives by SOC, offset and capacity of the interval."""
        slope_v = self.cell.slope(p.soc) if use_file_slope else self._slope_v(x, p.soc)
        columns, by_soc = self.soc_derivatives(x)
        by_soc *= slope_v[:, None]
        # the offset (column 1) also lowers the current through the resistances
        by_soc[:, 1] += (p.scale * by_group(p.ohm)).sum(axis=1) * self.cell.one_c_a
        return columns, by_soc

    def _slope_v(self, x: Floats, z: Floats) -> Floats:
        """Return the slope of the predicted voltages over SOC [V per unit SOC], as a secant over the SOC range of a row.

        The fitted curves are piecewise linear, so that the slope at a point changes at the next node.
        """
        above_v, below_v = (self._predict_at(x, z + shift).voltage_v for shift in (ROW_SOC / 2.0, -ROW_SOC / 2.0))
        return (above_v - below_v) / ROW_SOC


def by_sampling(rows: NDArray[np.void], ohm: Floats) -> Floats:
    """Return the variance of each row's voltage by slow or skewed sampling [V^2].

    The current through R_0 is measured with the voltage unless they have different times. The current through the RC pairs
    is always interpolated between samples.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW.
        ohm: Resistances, shape (n, RESISTANCES) [ohm].
    """
    return np.asarray(ohm[:, 0] ** 2 * rows["skew_a2"] + ohm[:, 1:].sum(axis=1) ** 2 * rows["between_a2"])


def kept_fraction(rows: NDArray[np.void]) -> Floats:
    """Return the fraction that each resistance's current keeps of its value at the reset of the RC pairs, shape (n, RESISTANCES).

    It is a mean over the row, and 0 for the series resistance.
    """
    from_reset, duration = rows["settled_s"][:, None] / TAUS, np.maximum(rows["duration_s"], 1.0)[:, None] / TAUS
    pairs = np.exp(-from_reset) * -np.expm1(-duration) / duration
    return np.column_stack([np.zeros(rows.size), pairs])


def by_group(values: Floats) -> Floats:
    """Return the sum over the resistances of each group, shape (n, SCALES)."""
    return np.asarray(np.add.reduceat(values, GROUP_STARTS, axis=1))
