"""Capacity and resistances of the pack over its history, by intervals of about a day."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.pack_voltage import RESISTANCE_GROUPS, SHAPE_NODES
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.aging import RESISTANCE, AgingVariance
from bms_estimator.pack_model.cell_curves import CellCurves, NodePosition
from bms_estimator.pack_model.equations import Equations
from bms_estimator.pack_model.fit import (
    FitError,
    PackFit,
    distinct_minima,
    mixture_moments,
    mixture_weights,
    reference_of,
    rows_of_this_pack,
    starts_near,
)
from bms_estimator.pack_model.intervals import HOUR_S
from bms_estimator.pack_model.solve import Minimum, single_threaded

RESISTANCE_SOC = np.array([0.5])
"""SOC at which resistances are compared."""
AT_REFERENCE = np.ones(1)
"""Arrhenius factor of the resistances at 25 °C, the temperature at which they are compared."""


@dataclass(frozen=True)
class QuantityCourse:
    """Values of one quantity over the history.

    Attributes:
        elapsed_s: Shape (n,), time at the start of each interval since the history began [s].
        value: Shape (n,), value in each interval.
        ln_covariance: Shape (n, n), covariance of ln of the values.
    """

    elapsed_s: Floats
    value: Floats
    ln_covariance: Floats

    @property
    def std(self) -> Floats:
        """Standard deviation of each value."""
        return np.asarray(self.value * np.sqrt(np.diag(self.ln_covariance)))

    def relative_change(self) -> tuple[float, float]:
        """Return the relative change from the first to the last value, and its standard deviation."""
        ratio = float(self.value[-1] / self.value[0])
        c = self.ln_covariance
        variance = float(c[0, 0] + c[-1, -1] - 2.0 * c[0, -1])
        return ratio - 1.0, ratio * float(np.sqrt(max(variance, 0.0)))


@dataclass(frozen=True)
class AgingCourse:
    """Capacity and resistances of the whole pack over its history.

    Attributes:
        end_s: Time of the last row since the history began [s].
        capacity: Capacity [Ah].
        series: Series resistance R_s at ``RESISTANCE_SOC`` and 25 °C [ohm].
        total: DC resistance with all RC pairs in steady state, at ``RESISTANCE_SOC`` and 25 °C [ohm].
    """

    end_s: float
    capacity: QuantityCourse
    series: QuantityCourse
    total: QuantityCourse


@single_threaded()
def aging_course(cell: CellCurves, rows: NDArray[np.void], previous: PackFit) -> AgingCourse:
    """Fit the pack's model from the minima of the last fit, and return capacity and resistances in each interval.

    Args:
        cell: Curves of the cell file.
        rows: Shape (n,), dtype HISTORY_ROW, in order of time.
        previous: Last fit of the history.

    Raises:
        FitError: The equations have no finite solution.
    """
    rows = rows_of_this_pack(rows, previous)
    try:
        equations = Equations(cell, rows, reference_of(previous, rows))
        minima = distinct_minima(equations, starts_near(equations, previous))
    except np.linalg.LinAlgError as error:
        raise FitError(f"the equations of {rows.size} history rows have no solution: {error}") from error
    if not minima:
        raise FitError("the last fit has no minimum to start from")
    mean, covariance = mixture_moments(mixture_weights(minima), [_ln_values(equations, each) for each in minima])
    elapsed_s, n = rows["elapsed_s"][equations.intervals.starts], equations.intervals.count
    capacity, series, total = (
        QuantityCourse(elapsed_s, np.exp(mean[part]), covariance[part, part])
        for part in (slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n))
    )
    return AgingCourse(float(rows["elapsed_s"][-1]), capacity, series, total)


def _ln_values(equations: Equations, minimum: Minimum) -> tuple[Floats, Floats]:
    """Return mean and covariance of ln of capacity [Ah], series and total resistance [ohm] in all intervals.

    All are linear functions of the unknowns, except the total resistance, whose derivatives are those at the minimum.
    """
    cell, u, x, n = equations.model.cell, equations.unknowns, minimum.x, equations.intervals.count
    ohm = cell.series * cell.resistances(RESISTANCE_SOC, AT_REFERENCE, AT_REFERENCE)[0]
    group_ohm = np.bincount(RESISTANCE_GROUPS, ohm) * np.exp(x[u.ln_r])
    ln_r = np.zeros((n, u.size))  # derivatives of the common factor of all resistances
    position = NodePosition.of(RESISTANCE_SOC, SHAPE_NODES)
    ln_r[:, u.shape.start + position.below] = position.weights[0]
    ln_r[:, u.shape.start + position.below + 1] = position.weights[1]
    ln_r[:, u.aging] = AgingVariance(RESISTANCE, cell, equations.intervals).trend[:, None]
    common = ln_r @ x
    derivatives = np.zeros((3 * n, u.size))
    derivatives[:n, u.ln_q] = np.eye(n)
    derivatives[n : 2 * n] = derivatives[2 * n :] = ln_r
    derivatives[n : 2 * n, u.ln_r.start] = 1.0
    derivatives[2 * n :, u.ln_r] = group_ohm / group_ohm.sum()
    ln_ah = x[u.ln_q] + np.log(cell.capacity_as / HOUR_S)
    mean = np.concatenate([ln_ah, common + np.log(group_ohm[0]), common + np.log(group_ohm.sum())])
    return mean, minimum.covariance_of(derivatives)
