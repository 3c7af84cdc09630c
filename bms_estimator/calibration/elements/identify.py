"""Identification of a cell from captures: RC ladder, a1..a15 of two equivalent RC pairs, corrected OCV.

``ladder_fit`` fits the resistances, once with a corrected and once with the given OCV. The result is scored by replays of the
estimator that start in mid-load, with the given and with the identified cell. A capture is held back if another one has about
its temperature: its replays then use a fit to the other captures. If such fits are rejected, the fit to all captures is
scored, because a fit without the only drive, or the only HPPC, extrapolates.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import (
    capture_contradictions,
    step_resistance,
    undetermined_start,
    without_excitation,
)
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.elements.cell_from_fit import (
    MIN_RMS_SOC,
    SECTIONS,
    cell_from_fit,
    ladder_prior,
    voltage_rms_v,
)
from bms_estimator.calibration.elements.ladder_fit import (
    MIN_SPAN_K,
    LadderFit,
    Run,
    fit_ladder,
    make_run,
    spans_temperature,
    temperature_contradictions,
    temperature_range,
)
from bms_estimator.calibration.elements.normal_equations import NormalEquations, correction_at, normal_equations
from bms_estimator.calibration.elements.replay_score import interval_score
from bms_estimator.calibration.ocv.overpotential import ocv_offset
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress, WorkCounter, no_progress


@dataclass(frozen=True)
class CaptureFit:
    """Result of the fit for one capture.

    Attributes:
        name: Name of the capture.
        samples: Number of samples in the capture.
        glitches: Number of dropped glitches.
        initial_soc: SOC at the first sample, 0..1.
        temperature_c: Lowest and highest temperature [C]; None without a sensor.
        miscount: Relative error of the counted charge. The SOC of the fit is corrected by it.
        voltage_rms_v: RMS residual of the voltage, weighted by time, at SOC above 0.1 [V].
        score_before: Interval score of replays with the given cell [%]; NaN when the capture is too short.
        score_after: Interval score with the identified cell [%].
        held_back: True if ``score_after`` is of a cell that was fitted without this capture.
    """

    name: str
    samples: int
    glitches: int
    initial_soc: float
    temperature_c: tuple[float, float] | None
    miscount: float
    voltage_rms_v: float
    score_before: float
    score_after: float
    held_back: bool


@dataclass(frozen=True)
class Identification:
    """An identified cell.

    Attributes:
        cell: The cell with its ladder, the elements of two RC pairs, and a corrected OCV if that improves the replays.
        elements: Value and standard error of ``r_s``, ``r_ts`` and ``r_tl`` at 25 C by SOC and name [ohm].
        captures: Fit of each capture, in the order given.
        left_out: Names of captures without excitation.
        ocv_correction_v: RMS of the change of the open-circuit voltage over SOC 0.1..1 [V]; 0 if the given OCV is used.
        score_before: Geometric mean of the captures' interval scores with the given cell [%]; NaN when none has a
            score.
        score_after: Geometric mean of the interval scores with the identified cell [%].
        undetermined_starts: Lines on captures whose SOC at the first sample was not given, and whose first voltage allows a wide
            range of SOC.
    """

    cell: CellModel
    elements: dict[float, dict[str, tuple[float, float]]]
    captures: tuple[CaptureFit, ...]
    left_out: tuple[str, ...]
    ocv_correction_v: float
    score_before: float
    score_after: float
    undetermined_starts: tuple[str, ...] = ()


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
        """Return, for each capture, the relative correction of its counted charge with which its voltage matches the fit best."""
        return [equations_of_run.miscount(self.fit.coefficients) for equations_of_run in self._equations]

    def outcome(
        self, before: Floats, after: Floats, left_out: tuple[str, ...], held_back: Collection[int]
    ) -> Identification:
        """Return the identification with this variant's cell.

        Args:
            before: Scores with the given cell [%].
            after: Scores with this variant's cell [%].
            left_out: Names of captures without excitation.
            held_back: Indices of the captures that the fit omits for their score.
        """
        fits = tuple(
            CaptureFit(
                name=run.capture.name,
                samples=run.capture.samples,
                glitches=run.capture.glitches,
                initial_soc=float(run.soc[0]),
                temperature_c=temperature_range([run]) if np.isfinite(run.capture.temperature_c).any() else None,
                miscount=run.miscount,
                voltage_rms_v=voltage_rms_v(self.cell, run),
                score_before=float(before[j]),
                score_after=float(after[j]),
                held_back=j in held_back,
            )
            for j, run in enumerate(self._runs)
        )
        change_v = correction_at(np.linspace(MIN_RMS_SOC, 1.0, 181)) @ self.fit.correction
        return Identification(
            cell=self.cell,
            elements={
                soc: {name: self.fit.resistance_sum(soc, *indices) for name, indices in SECTIONS.items()}
                for soc in REPORTED_SOC
            },
            captures=fits,
            left_out=left_out,
            ocv_correction_v=float(np.sqrt(np.mean(change_v**2))) if self._refine else 0.0,
            score_before=geometric_mean(before),
            score_after=geometric_mean(after),
        )

    def scores(self, held_back: Collection[int], work: WorkCounter) -> Floats:
        """Return the score of each capture's replays [%]."""
        return np.array(
            [
                interval_score(self._cell_for(j, held_back), run.capture, run.soc, work.part(run.soc.size))
                for j, run in enumerate(self._runs)
            ]
        )

    def _cell_for(self, j: int, held_back: Collection[int]) -> CellModel:
        """Return the cell for the replays of capture ``j``. Its fit omits this capture if it is held back."""
        if j not in held_back:
            return self.cell
        others = [k for k in range(len(self._runs)) if k != j]
        return self._cell_from(self._fit(others), others)

    def _fit(self, indices: Sequence[int]) -> LadderFit:
        """Fit the resistances to some captures."""
        has_span = spans_temperature(*temperature_range([self._runs[k] for k in indices]))
        prior = ladder_prior(self._cell, self._scale_ohm, refine_ocv=self._refine, spans_temperature=has_span)
        return fit_ladder([self._equations[k] for k in indices], prior)

    def _cell_from(self, fit: LadderFit, indices: Sequence[int]) -> CellModel:
        """Return the cell with the fit to some captures."""
        runs = [self._runs[k] for k in indices]
        return cell_from_fit(self._cell, fit, runs, self._scale_ohm, refine_ocv=self._refine)


def equations_of(runs: list[Run], cell: CellModel) -> list[NormalEquations]:
    """Return the normal equations of the regression over each capture."""
    scale_ohm = _resistance_scale(runs, cell)
    grid_v, grid_slope_v = ocv_grid(cell)
    grid = np.linspace(0.0, 1.0, grid_v.size)
    return [
        normal_equations(
            run.capture,
            run.soc,
            np.interp(run.soc, grid, grid_v) + ocv_offset(cell, run.capture_with_temperature, run.soc),
            np.interp(run.soc, grid, grid_slope_v),
            run.temperature_c,
            scale_ohm,
            cell.cell.series_count,
            run.miscount,
        )
        for run in runs
    ]


def _held_back(runs: list[Run]) -> list[int]:
    """Return the captures that a fit omits for their score, because another one is within ``MIN_SPAN_K`` of its temperature."""
    mean_c = [run.mean_c for run in runs]
    return [
        j for j, c in enumerate(mean_c) if any(k != j and abs(mean_c[k] - c) < MIN_SPAN_K for k in range(len(runs)))
    ]


def _resistance_scale(runs: list[Run], cell: CellModel) -> float:
    """Return the scale of the resistances [ohm]: the median of the current steps, or a typical value without steps."""
    steps = [ohm for ohm in (step_resistance(run.capture) for run in runs) if ohm is not None]
    return float(np.median(steps)) if steps else TYPICAL_DROP_V * cell.cell.series_count / cell.cell.capacity_ah


def geometric_mean(scores: Floats) -> float:
    """Return the geometric mean, in which a capture with a high score for every cell does not dominate."""
    finite = scores[np.isfinite(scores)]
    return float(np.exp(np.log(finite).mean())) if finite.size else float("nan")


MISCOUNT_PASSES = 3
"""Number of fits that refine the miscount of each capture. Iteration is needed because the OCV is nonlinear at a
knee."""
REGRESSION_WORK = 0.5
"""Computation time of the normal equations of a capture, relative to that of its replays."""
EQUAL_SCORE_RATIO = 1.05
"""Ratio up to which two scores count as equal. Four replays do not resolve a smaller difference."""


def identify(
    captures: Sequence[Columns],
    cell: CellModel,
    *,
    refine_ocv: bool = True,
    initial_soc: float | None = None,
    initial_socs: Mapping[str, float] = MappingProxyType({}),
    temperature_c: float | None = None,
    progress: Progress = no_progress,
) -> Identification:
    """Fit the ladder to captures jointly.

    Args:
        captures: Raw samples, rows of dtype ``SAMPLE``; each should start from rest.
        cell: Capacity, limits and OCV. A ladder supplies the temperature dependence if all captures are at one
            temperature.
        refine_ocv: Correct the open-circuit voltage as well if the correction improves the replays.
        initial_soc: SOC 0..1 at the first sample of each capture; None: from the voltage of its first rest.
        initial_socs: SOC 0..1 at the first sample of some captures by name, which overrides ``initial_soc``.
        temperature_c: Temperature of captures without a sensor [C]; None: 25 C.
        progress: Receives the finished fraction of the work.

    Raises:
        UserError: No capture has excitation, a capture contradicts the cell (sign of the current, capacity, OCV), a
            temperature is implausible, or replays get worse.
    """
    cleaned = [clean_capture(capture.name, capture.rows, cell) for capture in captures]
    excited = [clean for clean in cleaned if not without_excitation(clean, cell)]
    # without any load, the checks below report the missing excitation
    runs = [
        make_run(clean, cell, initial_socs.get(clean.name, initial_soc), temperature_c) for clean in excited or cleaned
    ]
    contradictions = [line for run in runs for line in capture_contradictions(run.capture, cell, float(run.soc[0]))]
    contradictions += [line for clean in excited for line in temperature_contradictions(clean, temperature_c)]
    if contradictions:
        raise UserError("\n".join(contradictions))
    variants = (False, True) if refine_ocv else (False,)  # with the given OCV, with a corrected OCV
    samples = sum(run.soc.size for run in runs)
    work = WorkCounter(progress, (1 + len(variants) + REGRESSION_WORK * MISCOUNT_PASSES) * samples)
    runs = _correct_miscounts(runs, cell, work, refine_ocv=refine_ocv)
    left_out = tuple(clean.name for clean in cleaned if without_excitation(clean, cell))
    equations = equations_of(runs, cell)
    candidates = [Candidate(runs, equations, cell, refine_ocv=refine) for refine in variants]
    before = np.array([interval_score(cell, run.capture, run.soc, work.part(run.soc.size)) for run in runs])
    held_back = _held_back(runs)
    after = [candidate.scores(held_back, work) for candidate in candidates]
    best = len(after) - 1  # the last candidate, if no capture has a score
    if np.isfinite(before).any():
        # scores of captures that are not held back favor the variant with more unknowns
        given, refined = (
            geometric_mean(scores[held_back] if held_back else scores) for scores in (after[0], after[-1])
        )
        best = int((EQUAL_SCORE_RATIO if held_back else 1.0) * refined < given)  # index in ``candidates``
    outcome = candidates[best].outcome(before, after[best], left_out, held_back)
    if outcome.score_after > EQUAL_SCORE_RATIO * outcome.score_before and held_back:
        own_scores = candidates[best].scores((), WorkCounter(no_progress, samples))
        own = candidates[best].outcome(before, own_scores, left_out, ())
        outcome = min(outcome, own, key=lambda scored: scored.score_after)
    unknown = [clean for clean in excited if initial_soc is None and clean.name not in initial_socs]
    undetermined = tuple(
        f"{clean.name}: give the SOC at the start (--soc), because {text}"
        for clean in unknown
        if (text := undetermined_start(clean, cell))
    )
    if outcome.score_after > EQUAL_SCORE_RATIO * outcome.score_before:
        raise UserError("\n".join([_worse_replays(outcome), *undetermined]))
    return replace(outcome, undetermined_starts=undetermined)


def _correct_miscounts(runs: list[Run], cell: CellModel, work: WorkCounter, *, refine_ocv: bool) -> list[Run]:
    """Return the captures with their counted charge rescaled so that knees of voltage and OCV coincide."""
    for _ in range(MISCOUNT_PASSES):
        miscounts = Candidate(runs, equations_of(runs, cell), cell, refine_ocv=refine_ocv).miscounts()
        runs = [run.with_added_miscount(added) for run, added in zip(runs, miscounts, strict=True)]
        work.part(REGRESSION_WORK * sum(run.soc.size for run in runs))(1.0)
    return runs


def _worse_replays(outcome: Identification) -> str:
    """Return the message on replays that get worse, with the scores of each capture."""
    lines = [
        f"{c.name}: {c.score_before:.2f} before, {c.score_after:.2f} after"
        for c in outcome.captures
        if np.isfinite(c.score_after)
    ]
    return (
        "replays that start in mid-load get worse: their interval score (smaller is better) goes from "
        f"{outcome.score_before:.2f} to {outcome.score_after:.2f} % of SOC; nothing is written: keep the cell file, or give "
        f"captures with more typical loads\n" + "\n".join(lines)
    )
