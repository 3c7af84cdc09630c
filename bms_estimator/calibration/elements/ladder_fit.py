"""Fit of an RC ladder's resistances to cleaned captures by regularized linear least squares with all resistances positive.

Module ``normal_equations`` describes the model, which is linear in all unknowns. All constants of this module were chosen by
the score of replays on drive cycles that were not part of the fit.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from bms_estimator.calibration.cleaning.capture_checks import initial_soc
from bms_estimator.calibration.cleaning.clean_capture import CleanCapture
from bms_estimator.calibration.elements.normal_equations import (
    KELVIN_NODES,
    PART_SIZE,
    SOC_NODES,
    SPLINES,
    UNBOUNDED,
    NormalEquations,
    correction_at,
)
from bms_estimator.calibration.ocv.overpotential import linear_interpolation_matrix, temperature_of
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C, RESISTANCES
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel

MIN_SPAN_K = 10.0
"""Minimum temperature difference that gives activation energies and dE/dT [K]."""
FULL_TOLERANCE_V = 0.03
"""Tolerance within which the first rest of a capture has the voltage of a full cell, so that the capture starts full, per cell
[V]. This rule applies only away from 25 C, because cold rests are not relaxed and their voltage gives a wrong SOC."""
MIN_DEVIATION_K = 5.0
"""Minimum deviation from 25 C at which ``FULL_TOLERANCE_V`` applies [K]."""
MIN_CELL_C = -45.0
"""Lowest plausible cell temperature [C]."""
MAX_CELL_C = 85.0
"""Highest plausible cell temperature [C]."""
PERCENTILES = (2.0, 98.0)
"""Percentiles of the captures' temperatures that become the temperature range of the ladder [%]."""


@dataclass(frozen=True)
class Run:
    """Cleaned capture with the SOC (0..1) and the temperature [C] at each sample."""

    capture: CleanCapture
    soc: Floats
    temperature_c: Floats
    miscount: float = 0.0
    """Relative correction of the counted charge. ``soc`` includes the correction."""

    def with_added_miscount(self, added: float) -> "Run":
        """Return a copy with ``miscount`` increased by ``added`` and the changes of ``soc`` rescaled accordingly."""
        miscount = self.miscount + added
        uncorrected_change = (self.soc - self.soc[0]) / (1.0 + self.miscount)
        return replace(self, soc=self.soc[0] + (1.0 + miscount) * uncorrected_change, miscount=miscount)

    @property
    def capture_with_temperature(self) -> CleanCapture:
        """``capture`` with the temperatures replaced by ``temperature_c``."""
        return replace(self.capture, temperature_c=self.temperature_c)

    @property
    def mean_c(self) -> float:
        """Mean temperature [C]."""
        return float(self.temperature_c.mean())


def make_run(capture: CleanCapture, cell: CellModel, soc: float | None, temperature_c: float | None) -> Run:
    """Return a capture with its SOC by coulomb counting from ``soc``, or from the SOC of its first rest if None."""
    if temperature_c is not None:
        capture = replace(capture, temperature_c=temperature_of(capture, temperature_c))
    temperatures_c = temperature_of(capture)
    first_soc = initial_soc(capture, cell) if soc is None else soc
    full_v = ocv_grid(cell)[0][-1]
    is_far_from_reference = abs(float(temperatures_c[0]) - REFERENCE_C) > MIN_DEVIATION_K
    if (
        soc is None
        and is_far_from_reference
        and abs(full_v - capture.start_v) < FULL_TOLERANCE_V * cell.cell.series_count
    ):
        first_soc = 1.0
    return Run(capture, first_soc - capture.discharged_ah / cell.cell.capacity_ah, temperatures_c)


def temperature_contradictions(capture: CleanCapture, temperature_c: float | None) -> list[str]:
    """Return a message if the temperature of a capture is implausible."""
    temperatures_c = temperature_of(capture, REFERENCE_C if temperature_c is None else temperature_c)
    if temperatures_c.min() >= MIN_CELL_C and temperatures_c.max() <= MAX_CELL_C:
        return []
    measured = f"temperature_c runs from {temperatures_c.min():.1f} to {temperatures_c.max():.1f}"
    return [f"{capture.name}: {measured}, but cells are between {MIN_CELL_C:g} and {MAX_CELL_C:g} C"]


def temperature_range(runs: list[Run]) -> tuple[float, float]:
    """Return the ``PERCENTILES`` of the temperatures of captures [C]."""
    low_c, high_c = np.percentile(np.concatenate([run.temperature_c for run in runs]), PERCENTILES)
    return round(float(low_c), 1), round(float(high_c), 1)


def spans_temperature(low_c: float, high_c: float) -> bool:
    """Return True if captures at these temperatures [C] give activation energies and dE/dT."""
    return high_c - low_c >= MIN_SPAN_K


ROUGHNESS_STD = 0.1
"""Prior std of the difference of a resistance between two SOC nodes, and between two neighboring RC pairs, relative to
the scale. The resistance per decade of time is about constant from a second to an hour."""
LOW_SOC = 0.15
"""SOC below which ``ROUGHNESS_STD`` is larger."""
LOW_SOC_ROUGHNESS = 4.0
"""Factor on ``ROUGHNESS_STD`` below ``LOW_SOC``."""
LEVEL_PRECISION = 1e-6
"""Inverse prior variance of a resistance relative to the scale. It only makes the information matrix regular."""
BEND_V = 10.0
"""Prior std of d2d/dSOC2 per cell [V]."""
LOW_BEND_SOC = 0.12
"""SOC below which the prior std is ``LOW_BEND_FACTOR`` times ``BEND_V``."""
LOW_BEND_FACTOR = 20.0
"""Factor on ``BEND_V`` below ``LOW_BEND_SOC``."""
OCV_INTERVALS = 20
"""Number of SOC intervals with independent errors of the given OCV."""
PER_KELVIN_STD_V = 1e-3
"""Prior std of u per cell [V/K]."""
MEASURED_PER_KELVIN_STD_V = 5e-5
"""Prior std of u per cell if the cell file contains a measured dE/dT [V/K]."""
FIXED_OCV_STD_V = 1e-6
"""Prior std of d if d is not fitted [V]."""
FIXED_PER_KELVIN_STD_V = 1e-9
"""Prior std of u if u is not fitted [V/K]."""
ZERO_FRACTION = 1e-6
"""Fraction of the scale below which a fitted resistance counts as 0."""
EVEN_SOC = np.linspace(0.0, 1.0, 201)
"""SOC grid of the prior of d."""


@dataclass(frozen=True)
class LadderFit:
    """Result of the fit.

    Attributes:
        correction: Coefficients of d, see ``correction_at``.
        per_kelvin_v: u at ``KELVIN_NODES`` [V/K].
        weak_ohm: Shape (RESISTANCES, SOC_NODES.size), part with the weak temperature dependence [ohm].
        strong_ohm: Part with the strong temperature dependence, in the shape of ``weak_ohm`` [ohm].
        covariance: Covariance of the weak and then the strong resistances, each row by row. It neglects the bounds at
            0.
    """

    correction: Floats
    per_kelvin_v: Floats
    weak_ohm: Floats
    strong_ohm: Floats
    covariance: Floats

    @property
    def coefficients(self) -> Floats:
        """All unknowns, in the order of the columns."""
        parts = self.correction, self.per_kelvin_v, self.weak_ohm.ravel(), self.strong_ohm.ravel()
        return np.concatenate(parts)

    def resistance_sum(self, soc: float, first: int, end: int) -> tuple[float, float]:
        """Return the sum of resistances ``first`` to ``end`` - 1 at ``soc`` and 25 C, and its standard error [ohm]."""
        node_weights = linear_interpolation_matrix(np.array([soc]), SOC_NODES)[0]
        row = np.zeros((2, RESISTANCES, SOC_NODES.size))
        row[:, first:end] = node_weights
        ohm = float((row[0] * (self.weak_ohm + self.strong_ohm)).sum())
        return ohm, float(np.sqrt(row.ravel() @ self.covariance @ row.ravel()))


@dataclass(frozen=True)
class Prior:
    """Prior of the fit.

    Attributes:
        ocv_error_v: Std of d at ``EVEN_SOC`` [V]; ``FIXED_OCV_STD_V`` if d is not fitted.
        per_kelvin_std_v: Std of u [V/K]; ``FIXED_PER_KELVIN_STD_V`` if u is not fitted.
        scale_ohm: Scale of the resistances [ohm].
        series: Cells in series.
        shapes: Shape (2, RESISTANCES, SOC_NODES.size), typical values of the weak and strong part of each resistance
            over SOC, relative to a mean.
        weak_share: Shape (RESISTANCES, SOC_NODES.size), given fraction of each resistance that is the weak part; None:
            the captures determine it.
    """

    ocv_error_v: Floats
    per_kelvin_std_v: float
    scale_ohm: float
    series: int
    shapes: Floats
    weak_share: Floats | None


def fit_ladder(captures: list[NormalEquations], prior: Prior) -> LadderFit:
    """Fit the resistances to all ``captures`` by least squares."""
    information = _prior_information(prior) + sum(capture.information for capture in captures)
    information_vector = np.asarray(sum(capture.information_vector for capture in captures))
    # matrix that gives all unknowns from the free ones; with a given weak fraction, only the sums of both parts are free
    from_free = np.eye(UNBOUNDED + 2 * PART_SIZE)
    if prior.weak_share is not None:
        weak_fraction = prior.weak_share.ravel()
        from_free = np.zeros((UNBOUNDED + 2 * PART_SIZE, UNBOUNDED + PART_SIZE))
        from_free[:UNBOUNDED, :UNBOUNDED] = np.eye(UNBOUNDED)
        from_free[UNBOUNDED : UNBOUNDED + PART_SIZE, UNBOUNDED:] = np.diag(weak_fraction)
        from_free[UNBOUNDED + PART_SIZE :, UNBOUNDED:] = np.diag(1.0 - weak_fraction)
    information = from_free.T @ information @ from_free
    # least squares with the Cholesky factor as rows has these normal equations
    cholesky = np.linalg.cholesky(information)
    lower_bounds = np.r_[np.full(UNBOUNDED, -np.inf), np.zeros(cholesky.shape[0] - UNBOUNDED)]
    target = np.linalg.solve(cholesky, from_free.T @ information_vector)
    unknowns = from_free @ lsq_linear(cholesky.T, target, bounds=(lower_bounds, np.inf), tol=1e-12, max_iter=500).x
    covariance = from_free @ np.linalg.inv(information) @ from_free.T
    ohm = np.where(unknowns[UNBOUNDED:] > ZERO_FRACTION * prior.scale_ohm, unknowns[UNBOUNDED:], 0.0)
    weak, strong = ohm.reshape(2, RESISTANCES, SOC_NODES.size)
    return LadderFit(unknowns[:SPLINES], unknowns[SPLINES:UNBOUNDED], weak, strong, covariance[UNBOUNDED:, UNBOUNDED:])


def _prior_information(prior: Prior) -> Floats:
    """Return the information matrix of the prior of all unknowns."""
    table = np.zeros((UNBOUNDED + 2 * PART_SIZE, UNBOUNDED + 2 * PART_SIZE))
    spline = correction_at(EVEN_SOC)
    deviation = spline / prior.ocv_error_v[:, None] * np.sqrt(OCV_INTERVALS / EVEN_SOC.size)
    bend = np.diff(spline, 2, axis=0) * (EVEN_SOC.size - 1) ** 2 / (BEND_V * prior.series)
    bend[EVEN_SOC[1:-1] < LOW_BEND_SOC] /= LOW_BEND_FACTOR
    table[:SPLINES, :SPLINES] = deviation.T @ deviation + bend.T @ bend / OCV_INTERVALS
    table[SPLINES:UNBOUNDED, SPLINES:UNBOUNDED] = np.eye(KELVIN_NODES.size) / prior.per_kelvin_std_v**2
    for first, shape in zip((UNBOUNDED, UNBOUNDED + PART_SIZE), prior.shapes, strict=True):
        roughness = _roughness_rows() / (ROUGHNESS_STD * prior.scale_ohm) / shape.ravel()
        part = roughness.T @ roughness + LEVEL_PRECISION * np.eye(PART_SIZE) / prior.scale_ohm**2
        table[first : first + PART_SIZE, first : first + PART_SIZE] = part
    return table


def _roughness_rows() -> Floats:
    """Return the differences of one part's resistances along SOC and between neighboring RC pairs, as rows."""
    unknowns = np.eye(PART_SIZE).reshape(RESISTANCES, SOC_NODES.size, PART_SIZE)  # index 0 is R_0, which is no RC pair
    std_factor = np.where(SOC_NODES < LOW_SOC, LOW_SOC_ROUGHNESS, 1.0)
    along = (unknowns[:, 1:] - unknowns[:, :-1]) / std_factor[None, :-1, None]
    across = (unknowns[2:] - unknowns[1:-1]) / std_factor[None, :, None]
    return np.vstack([along.reshape(-1, PART_SIZE), across.reshape(-1, PART_SIZE)])
