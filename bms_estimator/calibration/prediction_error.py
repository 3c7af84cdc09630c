"""The cost of a cell against captures, its derivatives, and the search for its least: see ``identify``."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration import elements
from bms_estimator.calibration.held_current import Load
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import ocv_and_slope
from bms_estimator.kernels.sensitivity import sensitivities, spline_weights, whiten
from bms_estimator.model.cell import CellModel

Floats = NDArray[np.float64]

DRIFT_TAU_S = 60.0
"""Correlation time of the drift in the error [s]; its standard deviation is taken to be that of the white part."""
BLOCK_S = 600.0
"""The prediction errors of stretches this long are taken as independent of each other [s]."""
CAUTION = 3.0
"""The errors' standard deviation counts this many times: a model's error is the same each time the same load comes.
Chosen, like the priors, on the NCR18650 captures, by the error on those left out of each fit: 8.2 mV with 1, 7.9 with
3, 8.0 with 4.5. Captures of other cells had no part in it, neither in the choice nor as a check."""
FIRST_SCALE_V = 0.02
"""Standard deviation of the errors of the first pass, per cell: of a cell file that does not fit yet [V]."""
LEAST_SCALE_V = 2e-4
"""No capture is trusted further, per cell [V]."""
SETTLED = 0.2
"""The passes end when the errors' standard deviation changes by less than this fraction."""
PASSES = 4
HUBER = 0.3
"""Prediction errors beyond this many of the standard deviations counted with count by their magnitude only."""
LOW_SOC = 0.1
"""Below it the form of the elements fails."""
FULL_SOC, LEAST_WEIGHT = 0.12, 0.01
"""Errors count in proportion to the square of SOC below FULL_SOC, down to this weight: in the plain proportion, heavy
pulses near empty bend the elements for all that is just above."""

THETA_STD = 0.7
"""The cell file's elements are right within a factor of 2, where a load says nothing (log parameters)."""
OCV_STD_V, BEND_STD_V = 0.03, 0.006
"""Correction of the OCV per cell [V]: of the curve as a whole (hysteresis, temperature) and of each coefficient beside;
and the second difference of the coefficients."""
COEFFICIENTS = 43
"""Of the correction: knots 0.025 of SOC apart."""
OCV_END = elements.SIZE + COEFFICIENTS
SOC_STD, SOC_STD_LOADED = 0.003, 0.05
"""SOC at the first sample, from a rest's voltage and from a loaded cell's."""
REST_STD_V = 0.001
"""Voltage of the first rest against the OCV, per cell [V]."""
CONTACT_STD = 0.1
"""Contact resistance of a capture, in series resistances of the cell."""

TOLERANCE = 1e-4
"""The search ends when a step lowers the cost by less than this fraction."""
ITERATIONS = 40
LONGEST_LOG_STEP, LONGEST_DELTA_STEP = 1.5, 0.1


@dataclass(frozen=True)
class Layout:
    """Where things stand among the unknowns z.

    Attributes:
        captures: How many captures are fitted.
    """

    captures: int

    theta: ClassVar[slice] = slice(0, elements.SIZE)
    ocv: ClassVar[slice] = slice(elements.SIZE, OCV_END)

    @property
    def soc(self) -> slice:
        """SOC at the start of each capture."""
        return slice(OCV_END, OCV_END + self.captures)

    @property
    def contact(self) -> slice:
        """Contact resistance of each capture."""
        return slice(OCV_END + self.captures, self.size)

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return OCV_END + 2 * self.captures

    def of(self, capture: int) -> NDArray[np.intp]:
        """The unknowns that one capture depends on, in the order of the kernel's Jacobian."""
        return np.array([*range(OCV_END), OCV_END + capture, OCV_END + self.captures + capture])


@dataclass(frozen=True)
class Solution:
    """Where the cost is least.

    Attributes:
        z: The unknowns.
        covariance: Of z.
        at_limit: Shape (15,), which of theta stand at their limit.
        scale_v: Standard deviation of the prediction errors that was counted with [V].
        iterations: Of all passes.
    """

    z: Floats
    covariance: Floats
    at_limit: NDArray[np.bool_]
    scale_v: float
    iterations: int


@dataclass(frozen=True)
class _Cost:
    """Cost at a point; its negative gradient and the Gauss-Newton matrix where they were asked for."""

    value: float
    descent: Floats
    normal: Floats


class Problem:
    """Captures to be explained by one cell.

    Args:
        cell: Capacity, OCV, and the elements to start from.
        loads: The captures.
        soc: SOC at the start of each.
        scale_ohm: About the series resistance [ohm].
        refine_ocv: Whether the OCV may be corrected.
    """

    def __init__(
        self, cell: CellModel, loads: Sequence[Load], soc: Sequence[float], scale_ohm: float, *, refine_ocv: bool
    ) -> None:
        self.loads = loads
        self.layout = layout = Layout(len(loads))
        self._grid = ocv_grid(cell)
        self._capacity_as = cell.cell.capacity_ah * 3600.0
        self._series = cell.cell.series_count
        self._lower, self._upper = elements.limits(scale_ohm)
        margin = 1e-3 * (self._upper - self._lower)
        self._centre = np.zeros(layout.size)
        self._centre[layout.theta] = np.clip(
            elements.start(cell.a[: elements.SIZE + 1]), self._lower + margin, self._upper - margin
        )
        self._centre[layout.soc] = soc
        self._prior = self._prior_information(scale_ohm, refine_ocv)
        counted = [start - load.discharged_ah / cell.cell.capacity_ah for start, load in zip(soc, loads, strict=True)]
        self._above = [soc > LOW_SOC for soc in counted]
        self._weights = [np.clip(soc / FULL_SOC, LEAST_WEIGHT**0.5, 1.0) ** 2 for soc in counted]

    def solve(self) -> Solution:
        """Passes of Levenberg-Marquardt, each with the noise that the one before left."""
        z, scale_v, iterations = self._centre, FIRST_SCALE_V * self._series, 0
        for _ in range(PASSES):
            z, count = self._search(z, scale_v)
            iterations += count
            left_v, clumping = self._errors(z)
            wanted_v = max(CAUTION * left_v * np.sqrt(clumping), LEAST_SCALE_V * self._series)
            if abs(wanted_v - scale_v) < SETTLED * scale_v:
                break
            scale_v = wanted_v
        return Solution(z, self._covariance(z, scale_v), self._at_limit(z), scale_v, iterations)

    def voltage_rms_v(self, z: Floats, capture: int) -> float:
        """RMS of measured less fitted voltage at SOC above ``LOW_SOC``, each second weighing the same [V]."""
        load = self.loads[capture]
        error_v, _ = self._simulate(z, capture, jacobian=False)
        duration_s = np.r_[np.diff(load.time_s), 0.0] * self._above[capture]
        return float(np.sqrt(duration_s @ error_v**2 / max(duration_s.sum(), 1e-9)))

    def _prior_information(self, scale_ohm: float, refine_ocv: bool) -> Floats:
        """Inverse covariance of what is known of z before any capture."""
        layout, information = self.layout, np.zeros((self.layout.size, self.layout.size))
        information[layout.theta, layout.theta] = np.eye(elements.SIZE) / THETA_STD**2
        bend = np.diff(np.eye(COEFFICIENTS), 2, axis=0) / (BEND_STD_V * self._series)
        level = (OCV_STD_V * self._series) ** 2 * (np.eye(COEFFICIENTS) + 1.0)
        smooth = np.linalg.inv(level) + bend.T @ bend
        information[layout.ocv, layout.ocv] = smooth if refine_ocv else 1e8 * smooth
        soc_std = [SOC_STD if load.resting_samples else SOC_STD_LOADED for load in self.loads]
        information[layout.soc, layout.soc] = np.diag(np.array(soc_std) ** -2)
        # one capture alone cannot tell its contacts from the cell
        contact_ohm = scale_ohm * (CONTACT_STD if len(self.loads) > 1 else 1e-6)
        information[layout.contact, layout.contact] = np.eye(len(self.loads)) / contact_ohm**2
        return information

    def _simulate(self, z: Floats, capture: int, *, jacobian: bool) -> tuple[Floats, Floats]:
        """Measured less simulated voltage [V], shape (n,); derivatives of the simulated one by ``Layout.of``."""
        load, layout = self.loads[capture], self.layout
        voltage_v = np.empty(load.time_s.size)
        table = np.empty((load.time_s.size, OCV_END + 2) if jacobian else (0, 0))
        sensitivities(
            load.time_s,
            load.current_a,
            load.held_a,
            z[layout.soc][capture],
            z[layout.contact][capture],
            self._capacity_as,
            elements.to_a(z[layout.theta]),
            *self._grid,
            z[layout.ocv],
            voltage_v,
            table,
        )
        return load.voltage_v - voltage_v, table

    def _prediction_errors(self, z: Floats, capture: int, *, jacobian: bool) -> Floats:
        """Whitened errors and, in further columns, their derivatives (sign turned); unit noise is 1 V."""
        error_v, table = self._simulate(z, capture, jacobian=jacobian)
        if jacobian:
            table[:, self.layout.theta] = table[:, self.layout.theta] @ elements.by_theta(z[self.layout.theta])
            rows = np.column_stack([error_v, table])
        else:
            rows = error_v[:, None]
        rows *= self._weights[capture][:, None]
        whiten(rows, self.loads[capture].time_s, 1.0, 1.0, DRIFT_TAU_S)
        return rows

    def _cost(self, z: Floats, scale_v: float, *, jacobian: bool) -> _Cost:
        """Negative log likelihood and prior."""
        off = z - self._centre
        pull = self._prior @ off
        value, descent, normal = 0.5 * float(off @ pull), -pull, self._prior.copy()
        for k in range(len(self.loads)):
            rows = self._prediction_errors(z, k, jacobian=jacobian) / scale_v
            size = np.abs(rows[:, 0])
            value += float(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).sum())
            if jacobian:
                rows *= np.sqrt(HUBER / np.maximum(size, HUBER))[:, None]
                products = rows.T @ rows
                places = self.layout.of(k)
                descent[places] += products[1:, 0]
                normal[np.ix_(places, places)] += products[1:, 1:]
            rest, slope = self._first_rest(z, k)
            value += 0.5 * rest**2
            descent += rest * slope
            normal += np.outer(slope, slope)
        return _Cost(value, descent, normal)

    def _first_rest(self, z: Floats, capture: int) -> tuple[float, Floats]:
        """First rest's voltage less the OCV there, in standard deviations, and the OCV's derivatives."""
        load, layout = self.loads[capture], self.layout
        slope = np.zeros(layout.size)
        if load.resting_samples == 0:
            return 0.0, slope
        w = np.zeros(8)
        soc = z[layout.soc][capture]
        first = layout.ocv.start + spline_weights(soc, COEFFICIENTS, w)
        near = z[first : first + 4]
        slope[first : first + 4] = w[:4]
        e_o, bare_slope = ocv_and_slope(soc, *self._grid)
        slope[layout.soc.start + capture] = bare_slope + w[4:] @ near
        std_v = REST_STD_V * self._series
        return float(load.start_v - e_o - w[:4] @ near) / std_v, slope / std_v

    def _search(self, z: Floats, scale_v: float) -> tuple[Floats, int]:
        """Levenberg-Marquardt with limits on theta."""
        damping = 1e-3
        here = self._cost(z, scale_v, jacobian=True)
        for iteration in range(ITERATIONS):
            trial, value = z, here.value
            for _ in range(12):
                trial = self._step(z, here, damping)
                value = self._cost(trial, scale_v, jacobian=False).value
                if value < here.value:
                    break
                damping = max(4.0 * damping, 1e-6)
            if not value < here.value:
                return z, iteration
            gained = here.value - value
            z, damping = trial, max(damping / 5.0, 1e-9)
            here = self._cost(z, scale_v, jacobian=True)
            if gained < TOLERANCE * here.value:
                return z, iteration + 1
        return z, ITERATIONS

    def _step(self, z: Floats, here: _Cost, damping: float) -> Floats:
        """The next point: theta within its limits and within reach of the last."""
        held = np.zeros(z.size, dtype=np.bool_)
        theta, downhill = z[self.layout.theta], here.descent[self.layout.theta]
        held[self.layout.theta] = ((theta <= self._lower) & (downhill < 0)) | ((theta >= self._upper) & (downhill > 0))
        free = ~held
        matrix = here.normal[np.ix_(free, free)]
        step = np.zeros(z.size)
        step[free] = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), here.descent[free])
        reach = np.full(elements.SIZE, LONGEST_LOG_STEP)
        reach[list(elements.DELTAS)] = LONGEST_DELTA_STEP
        trial = z + step
        trial[self.layout.theta] = np.clip(
            theta + np.clip(step[self.layout.theta], -reach, reach), self._lower, self._upper
        )
        return trial

    def _errors(self, z: Floats) -> tuple[float, float]:
        """Standard deviation of the prediction errors [V], and how many of them go together.

        The latter is the variance of sums over blocks against that of independent errors.
        """
        squares = sums = count = 0.0
        for k, load in enumerate(self.loads):
            r = self._prediction_errors(z, k, jacobian=False)[:, 0]
            spread = 1.4826 * float(np.median(np.abs(r)))
            r = np.clip(r, -4.0 * spread, 4.0 * spread)
            block = np.bincount((load.time_s / BLOCK_S).astype(np.intp), r)
            squares, sums, count = squares + float(r @ r), sums + float(block @ block), count + r.size
        return float(np.sqrt(squares / count)), max(sums / max(squares, 1e-30), 1.0)

    def _covariance(self, z: Floats, scale_v: float) -> Floats:
        """Covariance of z: that of an estimate that weighs the errors with caution, under the errors as they are."""
        information = self._cost(z, scale_v, jacobian=True).normal
        left_v, clumping = self._errors(z)
        ratio = min(clumping * left_v**2 / scale_v**2, 1.0)
        spread = np.linalg.inv(information)
        covariance = spread @ (ratio * (information - self._prior) + self._prior) @ spread
        return np.asarray(covariance, dtype=np.float64)

    def _at_limit(self, z: Floats) -> NDArray[np.bool_]:
        theta = z[self.layout.theta]
        return (theta <= self._lower) | (theta >= self._upper)
