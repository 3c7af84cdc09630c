"""Predicted voltage of each history row, with its variance and its derivatives with respect to the unknowns x.

    v = OCV(z, T) + error of the OCV(z) + hysteresis - sum of scaled resistances times currents + direction-dependent error
    z = SOC at the start of the interval - (charge - offset t) / (capacity)

All voltages are of one cell. docs/theory/pack-model.md has the complete equations.

An error that repeats whenever the pack passes an SOC in one direction is one unknown, the direction-dependent error. More passes
therefore do not lower the std of the curve below the std of this error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.accumulators.history import HYSTERESIS_SOC, ROW_SOC
from bms_estimator.kernels.cell_model.rc_ladder import (
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    TAUS,
    TREND_PAIR,
)
from bms_estimator.kernels.pack_voltage import MODEL_ROW, RESISTANCE_GROUPS, voltage_derivatives, voltages
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.aging import RESISTANCE, AgingVariance
from bms_estimator.pack_model.cell_curves import CellCurves, arrhenius
from bms_estimator.pack_model.intervals import Intervals
from bms_estimator.pack_model.prior import variance_between_nodes
from bms_estimator.pack_model.unknowns import SCALES, Unknowns

OVERPOTENTIAL_STD = 0.08
"""Relative std of the difference of the overpotential between charge and discharge at one SOC. A cell file that was identified
from pulses has this error in drives, too."""
PASS_FRACTION = 0.75
"""Std of the part of the overpotential's error that differs from pass to pass, as a fraction of the std of the part that
repeats (``OVERPOTENTIAL_STD``)."""
COUNT_STD_SOC = 0.004
"""Std of the SOC of a row due to counting [SOC]."""
KNEE_STD_SOC, KNEE_WIDTH_SOC = 0.008, 0.12
"""Std of the position of the OCV's knee near empty, and SOC over which it decays [SOC]. Without this std, a slow first charge
from empty gave an SOC 6 to 8 % wrong, because errors of offset, capacity and knee have equal effects on the voltage. Fits of 4 to
24 h of six real histories had an RMS error of 1.6 % with 0.008, 2.3 % with 0.015, and 1.9 % with 0.005."""
SURFACE_STD_SOC, SURFACE_WIDTH_SOC = 0.03, 0.25
"""Std of the difference between the SOC at the surface of the particles and the model's, per C-rate of discharge at 25 C, and
SOC over which it decays [SOC]. The C-rate is computed from the current filtered by ``TREND_PAIR``. The voltage collapses when the surface is empty: at 0 C
and 1C, a cell of 58 Ah ends its discharge with 20 % of its charge left. Without this std, the fit takes the collapse for the knee of
the OCV. Diffusion depends on the temperature as the strong part of the resistances does."""
START_LOAD_C = 0.6
"""Std of the load before the RC pairs were reset, as a C-rate. Assumed."""
GROUP_STARTS = [RESISTANCE_GROUPS.index(group) for group in range(SCALES)]
"""First resistance of each group."""

Derivatives = tuple[NDArray[np.intp], Floats]
"""Non-zero derivatives of n values with respect to the unknowns: indices of the unknowns and derivatives, both of shape (n,
k)."""


@dataclass(frozen=True)
class Prediction:
    """Predicted voltages of n rows."""

    voltage_v: Floats
    """Predicted voltage [V]."""
    soc: Floats
    """SOC z."""


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
        self.cell, self.unknowns, self.intervals = cell, u, intervals
        rows = intervals.rows
        temperature_c: Floats = rows["temperature_c"]
        weak, strong = arrhenius(LOW_ACTIVATION_ENERGY, temperature_c), arrhenius(HIGH_ACTIVATION_ENERGY, temperature_c)
        current_a = np.column_stack([rows["current_a"], rows["x_a"]])
        z = np.clip(reference.soc, 0.0, 1.0)
        ohm = cell.resistances(z, weak, strong)
        drop_v = np.add.reduceat(ohm * current_a, GROUP_STARTS, axis=1) @ np.exp(reference.ln_r)
        terms = np.zeros(rows.size, MODEL_ROW)
        terms["interval"], terms["segment"], terms["direction"] = (
            intervals.of_row,
            intervals.segment,
            rows["direction"] + 1.0,
        )
        terms["above_25_c_k"], terms["weak"], terms["strong"] = temperature_c - REFERENCE_C, weak, strong
        terms["one_c_a"], terms["hysteresis_factor"] = (
            cell.one_c_a,
            arrhenius(HYSTERESIS_ACTIVATION_ENERGY, temperature_c),
        )
        terms["current_a"], terms["hysteresis"] = current_a, rows["hysteresis"]
        # the hysteresis at the start of the segment, an unknown, decays with the throughput
        terms["start_h_decay"] = np.exp(-rows["throughput_soc"][:, None] / np.array(HYSTERESIS_SOC))
        # currents that remain in the RC pairs from a load of one std before their reset; the load is an unknown
        terms["start_load_a"] = START_LOAD_C * cell.one_c_a * remaining_fraction(rows)
        terms["aging_trend"] = AgingVariance(RESISTANCE, cell, intervals).trend[intervals.of_row]
        terms["direction_v"] = np.sqrt(
            cell.direction_std_v**2 + (OVERPOTENTIAL_STD * drop_v) ** 2 + variance_between_nodes(cell, z)
        )
        self.rows = terms
        """Quantities of each row, dtype MODEL_ROW."""
        scaled_ohm = ohm * np.exp(reference.ln_r)[np.array(RESISTANCE_GROUPS)]
        self.variance_v2 = self._variance(z, drop_v) + sampling_variance(rows, scaled_ohm)
        self.variance_v2 += surface_variance(cell, rows, z, drop_v, strong)
        """Variance of each row's voltage about its prediction [V^2]."""

    def _variance(self, z: Floats, drop_v: Floats) -> Floats:
        """Return the variance of each row's voltage about its prediction [V^2]."""
        near_empty, cell = np.exp(-((z / KNEE_WIDTH_SOC) ** 2)), self.cell
        pass_error_v2 = cell.direction_std_v**2 + (PASS_FRACTION * OVERPOTENTIAL_STD * drop_v) ** 2
        soc_error_v2 = (cell.slope(z) * (COUNT_STD_SOC + KNEE_STD_SOC * near_empty)) ** 2
        return np.asarray(pass_error_v2 + soc_error_v2)

    def soc(self, x: Floats) -> Floats:
        """Return the SOC of each row."""
        u, k = self.unknowns, self.intervals.of_row
        return np.asarray(x[u.soc][k] - self._drawn_soc(x) * np.exp(-x[u.ln_q][k]))

    def soc_derivatives(self, x: Floats) -> Derivatives:
        """Return the derivatives of the SOC of each row with respect to SOC, offset and ln of the capacity of its interval."""
        u, k = self.unknowns, self.intervals.of_row
        inverse_q = np.exp(-x[u.ln_q][k])
        at = np.column_stack([u.soc.start + k, u.offset.start + k, u.ln_q.start + k])
        return at, np.column_stack([np.ones(k.size), self.intervals.hours * inverse_q, self._drawn_soc(x) * inverse_q])

    def _drawn_soc(self, x: Floats) -> Floats:
        """Return the true charge since the interval's start, as a fraction of the declared capacity."""
        offset: Floats = x[self.unknowns.offset][self.intervals.of_row]
        return self.intervals.drawn_soc - offset * self.intervals.hours

    def predict(self, x: Floats) -> Prediction:
        """Return the predicted voltages."""
        soc = self.soc(x)
        return Prediction(self._voltages(x, soc), soc)

    def _voltages(self, x: Floats, z: Floats) -> Floats:
        """Return the voltages that ``x`` predicts if the rows' SOCs are ``z`` [V]."""
        return voltages(self.rows, self.cell.table, x, self.unknowns.first, z, self.cell.ocv(z))

    def derivatives(self, x: Floats, p: Prediction, *, use_file_slope: bool) -> Derivatives:
        """Return the derivatives of the predicted voltages.

        Args:
            x: Unknowns.
            p: Prediction at ``x``.
            use_file_slope: Use the slope of the cell file's OCV as the derivative with respect to the SOC. The covariance
                requires this, because the fitted correction is rough, and its slopes would count as information on the SOC.
        """
        slope_v = self.cell.slope(p.soc) if use_file_slope else self._slope_v(x, p.soc)
        through_soc = self.soc_derivatives(x)[1] * slope_v[:, None]  # chain rule
        return voltage_derivatives(self.rows, self.cell.table, x, self.unknowns.first, p.soc, through_soc)

    def _slope_v(self, x: Floats, z: Floats) -> Floats:
        """Return the slope of the predicted voltages over SOC [V per unit SOC], as a secant over the SOC range of a row.

        The fitted curves are piecewise linear, so that the slope at a point changes at the next node.
        """
        above_v, below_v = (self._voltages(x, z + shift) for shift in (ROW_SOC / 2.0, -ROW_SOC / 2.0))
        return (above_v - below_v) / ROW_SOC


def surface_variance(cell: CellCurves, rows: NDArray[np.void], z: Floats, drop_v: Floats, strong: Floats) -> Floats:
    """Return the variance of each discharge row's voltage due to the SOC at the surface of the particles [V^2].

    The slope of the OCV is that at the lower of the SOC and the SOC that corresponds to the voltage, because a collapsed voltage
    follows the slope of the knee.

    Args:
        cell: Curves of the cell file.
        rows: Shape (n,), dtype HISTORY_ROW.
        z: SOCs.
        drop_v: Overpotentials [V].
        strong: Arrhenius factors of diffusion.
    """
    discharge_c = np.where(rows["direction"] > 0.0, np.maximum(rows["x_a"][:, TREND_PAIR], 0.0), 0.0) / cell.one_c_a
    lowest = np.minimum(z, cell.soc(rows["voltage_v"] / cell.series + drop_v))
    std_soc = SURFACE_STD_SOC * discharge_c * strong * np.exp(-((lowest / SURFACE_WIDTH_SOC) ** 2))
    return np.asarray((cell.slope(lowest) * std_soc) ** 2)


def sampling_variance(rows: NDArray[np.void], ohm: Floats) -> Floats:
    """Return the variance of each row's voltage due to slow or skewed sampling [V^2].

    The current through R_0 is measured with the voltage unless they have different times. The current through the RC pairs
    is always interpolated between samples.

    Args:
        rows: Shape (n,), dtype HISTORY_ROW.
        ohm: Resistances, shape (n, RESISTANCES) [ohm].
    """
    return np.asarray(ohm[:, 0] ** 2 * rows["skew_a2"] + ohm[:, 1:].sum(axis=1) ** 2 * rows["between_a2"])


def remaining_fraction(rows: NDArray[np.void]) -> Floats:
    """Return the fraction of each resistance's current at the reset of the RC pairs that remains, shape (n, RESISTANCES).

    It is a mean over the row, and 0 for the series resistance.
    """
    from_reset, duration = rows["settled_s"][:, None] / TAUS, np.maximum(rows["duration_s"], 1.0)[:, None] / TAUS
    pairs = np.exp(-from_reset) * -np.expm1(-duration) / duration
    return np.column_stack([np.zeros(rows.size), pairs])
