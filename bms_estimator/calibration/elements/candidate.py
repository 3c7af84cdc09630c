"""Variant of the identification, with a corrected or with the given OCV."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import step_resistance
from bms_estimator.calibration.elements import two_branch_fit
from bms_estimator.calibration.elements.capture_run import MIN_SPAN_K, Run, spans_temperature, temperature_range
from bms_estimator.calibration.elements.cell_from_fit import MIN_RMS_SOC, cell_from_fit, voltage_rms_v
from bms_estimator.calibration.elements.identification import CaptureFit, Identification
from bms_estimator.calibration.elements.ladder_columns import correction_at
from bms_estimator.calibration.elements.ladder_fit import LadderFit, fit_ladder
from bms_estimator.calibration.elements.ladder_prior import ladder_prior
from bms_estimator.calibration.elements.normal_equations import NormalEquations, normal_equations
from bms_estimator.calibration.ocv.overpotential import ocv_offset
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel

REPORTED_SOC = (0.2, 0.5, 0.8)
"""SOCs at which the resistances are reported."""
TYPICAL_DROP_V = 0.09
"""Typical voltage drop of R_0 and the fast RC pairs at 1 C, per cell [V]. It defines the scale of all resistances if a
capture has no current steps."""


class Candidate:
    """Variant of the fit, with a corrected or with the given OCV."""

    def __init__(self, runs: list[Run], equations: list[NormalEquations], cell: CellModel, *, refine_ocv: bool) -> None:
        self._runs, self._equations, self._cell, self._refine = runs, equations, cell, refine_ocv
        self._scale_ohm = _resistance_scale(runs, cell)
        self.fit = self._fit(range(len(runs)))

    @cached_property
    def cell(self) -> CellModel:
        """Cell with the fit."""
        return self._cell_from(self.fit, range(len(self._runs)))

    def miscounts(self) -> list[float]:
        """Return the additional relative error of each capture's charge count at which its voltage matches the fit."""
        return [equations_of_run.miscount(self.fit.coefficients) for equations_of_run in self._equations]

    def is_held_back(self, j: int) -> bool:
        """Return True if another capture within ``MIN_SPAN_K`` of the temperature of capture ``j`` was given."""
        mean_c = [run.mean_c for run in self._runs]
        return any(k != j and abs(mean_c[k] - mean_c[j]) < MIN_SPAN_K for k in range(len(mean_c)))

    def outcome(self, before: Floats, after: Floats, left_out: tuple[str, ...]) -> Identification:
        """Return the identification with this variant's cell.

        Args:
            before: Scores with the given cell [%].
            after: Scores with this variant's cell [%].
            left_out: Names of captures without excitation.
        """
        fits = tuple(
            CaptureFit(
                name=run.load.name,
                samples=run.load.samples,
                glitches=run.load.glitches,
                initial_soc=float(run.soc[0]),
                temperature_c=temperature_range([run]) if np.isfinite(run.load.temperature_c).any() else None,
                miscount=run.miscount,
                voltage_rms_v=voltage_rms_v(self.cell, run),
                score_before=float(before[j]),
                score_after=float(after[j]),
                held_back=self.is_held_back(j),
            )
            for j, run in enumerate(self._runs)
        )
        change_v = correction_at(np.linspace(MIN_RMS_SOC, 1.0, 181)) @ self.fit.correction
        return Identification(
            cell=self.cell,
            elements={
                soc: {name: self.fit.branches(soc, *indices) for name, indices in two_branch_fit.SECTIONS.items()}
                for soc in REPORTED_SOC
            },
            captures=fits,
            left_out=left_out,
            ocv_correction_v=float(np.sqrt(np.mean(change_v**2))) if self._refine else 0.0,
            score_before=geometric_mean(before),
            score_after=geometric_mean(after),
        )

    def cell_for(self, j: int) -> CellModel:
        """Return the cell that is scored by capture ``j``: of a fit without this capture if it is held back."""
        if not self.is_held_back(j):
            return self.cell
        others = [k for k in range(len(self._runs)) if k != j]
        return self._cell_from(self._fit(others), others)

    def _fit(self, which: Sequence[int]) -> LadderFit:
        """Fit the resistances to the captures ``which``."""
        has_span = spans_temperature(*temperature_range([self._runs[k] for k in which]))
        prior = ladder_prior(self._cell, self._scale_ohm, refine_ocv=self._refine, spans_temperature=has_span)
        return fit_ladder([self._equations[k] for k in which], prior)

    def _cell_from(self, fit: LadderFit, which: Sequence[int]) -> CellModel:
        """Return the cell with the fit to the captures ``which``."""
        runs = [self._runs[k] for k in which]
        return cell_from_fit(self._cell, fit, runs, self._scale_ohm, refine_ocv=self._refine)


def equations_of(runs: list[Run], cell: CellModel) -> list[NormalEquations]:
    """Return the normal equations of the regression over each capture."""
    scale_ohm = _resistance_scale(runs, cell)
    grid_v, grid_slope_v = ocv_grid(cell)
    grid = np.linspace(0.0, 1.0, grid_v.size)
    return [
        normal_equations(
            run.load,
            run.soc,
            np.interp(run.soc, grid, grid_v) + ocv_offset(cell, run.load_with_temperature, run.soc),
            np.interp(run.soc, grid, grid_slope_v),
            run.temperature_c,
            scale_ohm,
            cell.cell.series_count,
            run.miscount,
        )
        for run in runs
    ]


def _resistance_scale(runs: list[Run], cell: CellModel) -> float:
    """Return the scale of the resistances [ohm]: the median of the current steps, or a typical value without steps."""
    steps = [ohm for ohm in (step_resistance(run.load) for run in runs) if ohm is not None]
    return float(np.median(steps)) if steps else TYPICAL_DROP_V * cell.cell.series_count / cell.cell.capacity_ah


def geometric_mean(scores: Floats) -> float:
    """Return the geometric mean, in which a capture with a high score for every cell does not dominate."""
    finite = scores[np.isfinite(scores)]
    return float(np.exp(np.log(finite).mean())) if finite.size else float("nan")
