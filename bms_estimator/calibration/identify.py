"""Identification of a1..a15 from captures: a prediction-error fit with analytic sensitivities.

What the model leaves of a voltage wanders for minutes under the noise of the samples. Taken as white it would claim
seven to twenty-five times the information there is (NCR18650), and let the slow part of the error decide. So errors pass the Kalman predictor of
white noise plus a Gauss-Markov drift, and the squares of its one-step prediction errors are made least (large ones
by their magnitudes: Huber).

With a1..a15 go: the SOC at the start of each capture, held by the voltage of its first rest; where several captures
are fitted, a contact resistance of each; and a smooth correction of the open-circuit voltage, a cubic B-spline held to
zero and to smoothness. Captures not used for the fit are predicted better with the correction, by a sixth to a quarter
of the error (NCR18650): relaxation goes on for hours, and what is left after a rest of minutes depends on the test.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.calibration import elements
from bms_estimator.calibration.capture_checks import contradictions, step_resistance
from bms_estimator.calibration.held_current import Load, thinned, whole_load
from bms_estimator.calibration.identifiability import Parameter, parameters
from bms_estimator.calibration.prediction_error import Problem, Solution
from bms_estimator.estimator.records import ocv_grid
from bms_estimator.kernels.cell import r_s, soc_from_ocv
from bms_estimator.kernels.sensitivity import spline_weights
from bms_estimator.model.cell import ELEMENTS, CellModel, TableOcv
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError

Floats = NDArray[np.float64]

OCV_STEP = 0.01
"""Nodes of the corrected table: at each such step of SOC, and where the cell file has one."""
LEAST_SLOPE_V = 1e-3
"""The corrected table rises at least so steeply, per cell and 1 of SOC [V]."""
SHOWN_SOC = (0.2, 0.5, 0.8)
"""SOCs at which the elements are reported."""


@dataclass(frozen=True)
class CaptureFit:
    """What the fit says of one capture.

    Attributes:
        name: What it is called.
        samples: How many it had.
        glitches: How many were left out as glitches.
        steps: How many steps of held current were fitted.
        initial_soc: At the first sample, identified, 0..1.
        initial_soc_std: Its standard error.
        contact_ohm: Series resistance beside R_s; 0 where only one capture is fitted [ohm].
        voltage_rms_v: Of the fitted error, each second weighing the same, SOC above 0.1 [V].
    """

    name: str
    samples: int
    glitches: int
    steps: int
    initial_soc: float
    initial_soc_std: float
    contact_ohm: float
    voltage_rms_v: float


@dataclass(frozen=True)
class Identification:
    """An identified cell.

    Attributes:
        cell: The cell with its new elements and open-circuit voltage.
        parameters: a1..a15 in order.
        correlation: Of their estimates, shape (15, 15).
        elements: SOC -> element -> value, standard error [ohm, F].
        captures: In the order given.
        ocv_correction_v: RMS of the change of the open-circuit voltage over SOC 0.1..1 [V].
        iterations: Of Levenberg-Marquardt, all passes.
    """

    cell: CellModel
    parameters: tuple[Parameter, ...]
    correlation: Floats
    elements: dict[float, dict[str, tuple[float, float]]]
    captures: tuple[CaptureFit, ...]
    ocv_correction_v: float
    iterations: int


def identify(captures: Sequence[Columns], cell: CellModel, *, refine_ocv: bool = True) -> Identification:
    """Fit a1..a15 to captures jointly.

    Args:
        captures: Raw samples, rows of dtype ``SAMPLE``; each should start from rest.
        cell: Capacity, limits and OCV; its elements are where the search starts, a factor of 2 off does no harm.
        refine_ocv: Correct the open-circuit voltage as well.

    Raises:
        UserError: A capture without excitation, or one that contradicts the cell: sign of the current, capacity, OCV.
    """
    whole = [whole_load(capture.name, capture.rows, cell) for capture in captures]
    found = [line for load in whole for line in contradictions(load, cell)]
    if found:
        raise UserError("\n".join(found))
    loads = [thinned(load, cell.cell.capacity_ah) for load in whole]
    known_ohm = [ohm for ohm in map(step_resistance, whole) if ohm is not None]
    scale_ohm = float(np.median(known_ohm)) if known_ohm else r_s(0.5, cell.a)
    problem = Problem(cell, loads, [initial_soc(load, cell) for load in loads], scale_ohm, refine_ocv=refine_ocv)
    solution = problem.solve()
    return _outcome(cell, problem, solution, refine_ocv)


def initial_soc(load: Load, cell: CellModel) -> float:
    """SOC at the first sample from the voltage of the first rest; of a first sample under load, with i R_s added."""
    current_a = 0.0 if load.resting_samples else float(load.current_a[0])
    return soc_from_ocv(load.start_v + current_a * r_s(0.5, cell.a), *ocv_grid(cell))


def _outcome(cell: CellModel, problem: Problem, solution: Solution, refine_ocv: bool) -> Identification:
    layout, z = problem.layout, solution.z
    theta = z[layout.theta]
    a = elements.to_a(theta)
    jacobian = elements.by_theta(theta)
    covariance = jacobian @ solution.covariance[layout.theta, layout.theta] @ jacobian.T
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    soc_std = np.sqrt(np.diag(solution.covariance))[layout.soc]
    fits = tuple(
        CaptureFit(
            name=load.name,
            samples=load.samples,
            glitches=load.glitches,
            steps=load.time_s.size,
            initial_soc=float(z[layout.soc][k]),
            initial_soc_std=float(soc_std[k]),
            contact_ohm=float(z[layout.contact][k]),
            voltage_rms_v=problem.voltage_rms_v(z, k),
        )
        for k, load in enumerate(problem.loads)
    )
    new = _with_elements(cell, a)
    change_v = 0.0
    if refine_ocv:
        new = new.model_copy(update={"ocv": corrected_ocv(cell, z[layout.ocv])})
        soc = np.linspace(0.1, 1.0, 181)
        change_v = float(np.sqrt(np.mean(spline(z[layout.ocv], soc) ** 2)))
    return Identification(
        cell=new,
        parameters=parameters(a, std, correlation, solution.at_limit),
        correlation=correlation,
        elements={soc: _elements_at(soc, a, covariance) for soc in SHOWN_SOC},
        captures=fits,
        ocv_correction_v=change_v,
        iterations=solution.iterations,
    )


def _with_elements(cell: CellModel, a: Floats) -> CellModel:
    """The cell with a1..a15; bounds of the adaptation law stay where they still hold the value."""
    table = cell.model_dump()
    for name, (first, amplitude, offset) in ELEMENTS.items():
        table[name] = {amplitude: float(a[first]), "exponent": float(a[first + 1]), offset: float(a[first + 2])}
    table["adaptation"] = {
        name: bounds
        for name, bounds in table["adaptation"].items()
        if bounds["lower"] <= a[int(name[1:])] <= bounds["upper"]
    }
    return CellModel.model_validate(table)


def spline(coefficients_v: Floats, soc: Floats) -> Floats:
    """The correction of the open-circuit voltage at ``soc`` [V]."""
    w = np.zeros(8)
    values = np.empty(soc.size)
    for j, x in enumerate(soc):
        first = spline_weights(x, coefficients_v.size, w)
        values[j] = w[:4] @ coefficients_v[first : first + 4]
    return values


def corrected_ocv(cell: CellModel, coefficients_v: Floats) -> TableOcv:
    """The cell's open-circuit voltage with the correction, as an increasing table."""
    grid_v, _ = ocv_grid(cell)
    nodes = np.linspace(0.0, 1.0, grid_v.size)
    soc = np.linspace(0.0, 1.0, round(1.0 / OCV_STEP) + 1)
    if isinstance(cell.ocv, TableOcv):
        own = np.array(cell.ocv.soc)
        far = np.abs(own[:, None] - soc).min(axis=1) > 0.2 * OCV_STEP
        soc = np.sort(np.r_[soc, own[far]])
    slope = LEAST_SLOPE_V * cell.cell.series_count * soc
    ocv_v = np.maximum.accumulate(np.interp(soc, nodes, grid_v) + spline(coefficients_v, soc) - slope) + slope
    return TableOcv(form="table", soc=tuple(soc.tolist()), ocv_v=tuple(ocv_v.tolist()))


def _elements_at(soc: float, a: Floats, covariance: Floats) -> dict[str, tuple[float, float]]:
    """Elements (2.5)-(2.9) at ``soc`` with standard errors from the covariance of a1..a15."""
    found = {}
    for name, (first, _, _) in ELEMENTS.items():
        sign = -1.0 if name.startswith("c_") else 1.0
        decay = np.exp(-a[first + 1] * soc)
        slope = np.array([sign * decay, -sign * a[first] * soc * decay, 1.0])
        part = covariance[first - 1 : first + 2, first - 1 : first + 2]
        found[name] = (float(sign * a[first] * decay + a[first + 2]), float(np.sqrt(slope @ part @ slope)))
    return found
