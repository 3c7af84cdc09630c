"""Identification of a cell from captures: RC ladder, a1..a15 of two equivalent RC pairs, corrected OCV.

``ladder_fit`` fits the resistances. The result is scored by replays of the estimator that start in mid-load, with the
given and with the identified cell. If other captures at about the temperature of a capture were given, the replays of
that capture use a fit without it (hold-out).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import (
    capture_contradictions,
    step_resistance,
    without_excitation,
)
from bms_estimator.calibration.cleaning.clean_capture import CleanCapture, clean_capture
from bms_estimator.calibration.elements import two_branch_fit
from bms_estimator.calibration.elements.ladder_fit import (
    EVEN_SOC,
    FIXED_OCV_STD_V,
    FIXED_PER_KELVIN_STD_V,
    KELVIN_NODES,
    MEASURED_PER_KELVIN_STD_V,
    PER_KELVIN_STD_V,
    SOC_NODES,
    TYPICAL_DROP_V,
    ZERO_FRACTION,
    LadderFit,
    NormalEquations,
    Prior,
    correction_at,
    fit_ladder,
    normal_equations,
)
from bms_estimator.calibration.elements.replay_score import MAX_STEP_S, interval_score
from bms_estimator.calibration.ocv.overpotential import (
    arrhenius,
    linear_interpolation_matrix,
    ocv_offset,
    overpotential,
    temperature_of,
)
from bms_estimator.calibration.ocv.slow_curve import PAIR_V
from bms_estimator.calibration.ocv.sources import REST_SHARE_STD, has_plateau
from bms_estimator.estimator.filter_settings import CURVE_ERROR_SOC, CURVE_ERROR_V
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import r_s, soc_from_ocv
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C, RESISTANCES, STRONG_J, weak_share
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, Ladder, TableOcv
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress, WorkCounter, no_progress

REPORTED_SOC = (0.2, 0.5, 0.8)
"""SOCs at which the resistances are reported."""
OCV_STEP = 0.01
"""SOC step between the nodes of the corrected OCV table."""
MIN_SLOPE_V = 1e-3
"""Minimum slope dOCV/dSOC of the corrected table per cell [V]."""
MIN_SPAN_K = 10.0
"""Minimum temperature difference that gives activation energies and dE/dT [K]."""
FULL_TOLERANCE_V = 0.03
"""Maximum distance of the voltage of a first rest from the voltage of a full cell at which the capture counts as starting
full, per cell [V]. This rule applies only away from 25 C, because cold rests are not relaxed and their voltage gives a
wrong SOC."""
COLD_K = 5.0
"""Minimum deviation from 25 C at which ``FULL_TOLERANCE_V`` applies [K]."""
MIN_CELL_C = -45.0
"""Lowest plausible cell temperature [C]."""
MAX_CELL_C = 85.0
"""Highest plausible cell temperature [C]."""
PERCENTILES = (2.0, 98.0)
"""Percentiles of the captures' temperatures that become the temperature range of the ladder [%]."""
LADDER_STD = 0.1
"""Relative std of resistances between cells of one make: two NCR18650 differ by 5 to 8 %, and cells age."""
GENERIC_STD = 0.3
"""Minimum relative std of a generic ladder. A ladder with a smaller std was identified, so that its temperature range
comes from captures."""
SHAPE_MIN_SOC = 0.4
"""SOC above which a resistance is averaged to normalize its shape."""
SHAPE_LIMITS = (0.2, 20.0)
"""Limits of a resistance relative to its mean above ``SHAPE_MIN_SOC``."""
MIN_RMS_SOC = 0.1
"""Lower SOC limit of the reported RMS errors and of the RMS change of the OCV."""
MIN_ERROR_V = 1e-5
"""Minimum model error written to a cell file [V]. A cell file requires a value above 0."""
COUNT_PASSES = 3
"""Number of fits that refine the miscount of each capture. Iteration is needed because the OCV is nonlinear at a
knee."""
REGRESSION_WORK = 0.5
"""Time for the normal equations of a capture, relative to the time for the replays of the capture."""
EQUAL_SCORE_RATIO = 1.05
"""Ratio up to which two scores count as equal. Four replays do not resolve a smaller difference."""


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
    """

    cell: CellModel
    elements: dict[float, dict[str, tuple[float, float]]]
    captures: tuple[CaptureFit, ...]
    left_out: tuple[str, ...]
    ocv_correction_v: float
    score_before: float
    score_after: float


@dataclass(frozen=True)
class Run:
    """Cleaned capture with the SOC (0..1) and the temperature [C] at each sample."""

    load: CleanCapture
    soc: Floats
    temperature_c: Floats
    miscount: float = 0.0
    """Relative correction of the counted charge. ``soc`` includes the correction."""

    def recounted(self, added: float) -> "Run":
        """Return a copy with ``miscount`` increased by ``added`` and the changes of ``soc`` rescaled accordingly."""
        miscount = self.miscount + added
        uncorrected_change = (self.soc - self.soc[0]) / (1.0 + self.miscount)
        return replace(self, soc=self.soc[0] + (1.0 + miscount) * uncorrected_change, miscount=miscount)

    @property
    def load_with_temperature(self) -> CleanCapture:
        """``load`` with the temperatures replaced by ``temperature_c``."""
        return replace(self.load, temperature_c=self.temperature_c)

    @property
    def mean_c(self) -> float:
        """Mean temperature [C]."""
        return float(self.temperature_c.mean())


def identify(
    captures: Sequence[Columns],
    cell: CellModel,
    *,
    refine_ocv: bool = True,
    initial_soc: float | None = None,
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
        temperature_c: Temperature of captures without a sensor [C]; None: 25 C.
        progress: Receives the finished fraction of the work.

    Raises:
        UserError: No capture has excitation, a capture contradicts the cell (sign of the current, capacity, OCV), a
            temperature is implausible, or replays get worse.
    """
    cleaned = [clean_capture(capture.name, capture.rows, cell) for capture in captures]
    loads = [load for load in cleaned if not without_excitation(load, cell)]
    # without any load, the checks below report the missing excitation
    runs = [_run(load, cell, initial_soc, temperature_c) for load in loads or cleaned]
    contradictions = [line for run in runs for line in capture_contradictions(run.load, cell, float(run.soc[0]))]
    contradictions += [line for load in loads for line in _wrong_temperature(load, temperature_c)]
    if contradictions:
        raise UserError("\n".join(contradictions))
    variants = (False, True) if refine_ocv else (False,)  # with the given OCV, with a corrected OCV
    samples = sum(run.soc.size for run in runs)
    work = WorkCounter(progress, (1 + len(variants) + REGRESSION_WORK * COUNT_PASSES) * samples)
    runs = _recounted(runs, cell, work, refine_ocv=refine_ocv)
    left_out = tuple(load.name for load in cleaned if without_excitation(load, cell))
    equations = _equations_of(runs, cell)
    candidates = [_Candidate(runs, equations, cell, refine_ocv=refine) for refine in variants]
    before = np.array([interval_score(cell, run.load, run.soc, work.part(run.soc.size)) for run in runs])
    after = [candidate.scores(work) for candidate in candidates]
    best = len(after) - 1  # the last candidate, if no capture has a score
    if np.isfinite(before).any():
        # scores of captures that are not held back favor the variant with more unknowns
        held_back = [j for j in range(len(runs)) if candidates[0].is_held_back(j)]
        given, refined = (
            _geometric_mean(scores[held_back] if held_back else scores) for scores in (after[0], after[-1])
        )
        best = int((EQUAL_SCORE_RATIO if held_back else 1.0) * refined < given)  # index in ``candidates``
    outcome = candidates[best].outcome(before, after[best], left_out)
    if outcome.score_after > EQUAL_SCORE_RATIO * outcome.score_before:
        raise UserError(_worse_replays(outcome))
    return outcome


def initial_soc(load: CleanCapture, cell: CellModel) -> float:
    """Return SOC at the first sample by the voltage of the first rest; without a rest, by the voltage plus i R_s."""
    current_a = 0.0 if load.resting_samples else float(load.current_a[0])
    return soc_from_ocv(load.start_v + current_a * r_s(0.5, cell.a), *ocv_grid(cell))


class _Candidate:
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
        return [equations_of_run.miscount(self.fit) for equations_of_run in self._equations]

    def scores(self, work: WorkCounter) -> Floats:
        """Return the score of each capture's replays [%], by a fit without the capture if it is held back."""
        return np.array(
            [
                interval_score(self._cell_for(j), run.load, run.soc, work.part(run.soc.size))
                for j, run in enumerate(self._runs)
            ]
        )

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
                temperature_c=_temperature_range([run]) if np.isfinite(run.load.temperature_c).any() else None,
                miscount=run.miscount,
                voltage_rms_v=_rms(self.cell, run),
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
            score_before=_geometric_mean(before),
            score_after=_geometric_mean(after),
        )

    def _cell_for(self, j: int) -> CellModel:
        if not self.is_held_back(j):
            return self.cell
        others = [k for k in range(len(self._runs)) if k != j]
        return self._cell_from(self._fit(others), others)

    def _fit(self, which: Sequence[int]) -> LadderFit:
        """Fit the resistances to the captures ``which``."""
        low_c, high_c = _temperature_range([self._runs[k] for k in which])
        given = self._cell.ladder
        spans_temperature = high_c - low_c >= MIN_SPAN_K
        series = self._cell.cell.series_count
        entropy_v = PER_KELVIN_STD_V if _per_kelvin(self._cell) is None else MEASURED_PER_KELVIN_STD_V
        prior = Prior(
            ocv_error_v=_curve_error(self._cell) if self._refine else np.full(EVEN_SOC.size, FIXED_OCV_STD_V),
            per_kelvin_v=(entropy_v if spans_temperature and self._refine else FIXED_PER_KELVIN_STD_V) * series,
            scale_ohm=self._scale_ohm,
            series=series,
            shapes=self._shapes(),
            weak_share=None if spans_temperature else weak_share(SOC_NODES) if given is None else _weak_share_of(given),
        )
        return fit_ladder([self._equations[k] for k in which], prior)

    def _cell_from(self, fit: LadderFit, which: Sequence[int]) -> CellModel:
        """Return the cell with the fit to the captures ``which``."""
        runs = [self._runs[k] for k in which]
        low_c, high_c = _temperature_range(runs)
        given = self._cell.ladder
        spans_temperature = high_c - low_c >= MIN_SPAN_K
        if not spans_temperature and given is not None and given.std < GENERIC_STD:
            low_c, high_c = min(low_c, given.temperature_c[0]), max(high_c, given.temperature_c[1])
        ohm, ohm_std = fit.branches(0.5, 0, RESISTANCES)
        ladder = Ladder(
            soc=_tuple(SOC_NODES),
            weak_ohm=tuple(map(_tuple, fit.weak_ohm)),
            strong_ohm=tuple(map(_tuple, fit.strong_ohm)),
            std=round(float(np.hypot(LADDER_STD, ohm_std / max(ohm, 1e-9 * self._scale_ohm))), 3),
            error_v=1.0,  # replaced below
            temperature_c=(low_c, high_c),
        )
        update: dict[str, object] = {"ladder": ladder, "adaptation": {}, **two_branch_fit.cell_file_sections(ladder)}
        if self._refine:
            update["ocv"] = _corrected_ocv(self._cell, fit, entropy=spans_temperature)
        new = self._cell.model_copy(update=update)
        error_v = max(float(np.sqrt(np.mean([_rms(new, run) ** 2 for run in runs]))), MIN_ERROR_V)
        return new.model_copy(update={"ladder": ladder.model_copy(update={"error_v": error_v})})

    def _shapes(self) -> Floats:
        """Return the prior shape of the weak and strong part of each resistance over SOC, at ``SOC_NODES``.

        The shape of an identified ladder is used unchanged. Of a generic ladder the square root of the shape is used,
        because cells differ. The shape is constant for a cell with a voltage plateau, because the generic shape did not
        fit the captures of an LFP cell.
        """
        given, grid_v = self._cell.ladder, ocv_grid(self._cell)[0]
        if given is None or has_plateau(np.linspace(0.0, 1.0, grid_v.size), grid_v, self._cell.cell.series_count):
            return np.ones((2, RESISTANCES, SOC_NODES.size))
        rows = _at_nodes(given)
        mean_ohm = rows[:, :, SOC_NODES > SHAPE_MIN_SOC].mean(axis=2, keepdims=True)
        is_zero = mean_ohm < ZERO_FRACTION * self._scale_ohm  # has no shape
        shapes = np.clip(np.where(is_zero, 1.0, rows / np.where(is_zero, 1.0, mean_ohm)), *SHAPE_LIMITS)
        return np.asarray(np.sqrt(shapes) if given.std >= GENERIC_STD else shapes)


def _run(load: CleanCapture, cell: CellModel, soc: float | None, temperature_c: float | None) -> Run:
    """Return a capture with its SOC by coulomb counting from ``soc``. None: from its first rest."""
    if temperature_c is not None:
        load = replace(load, temperature_c=temperature_of(load, temperature_c))
    temperature = temperature_of(load)
    first_soc = initial_soc(load, cell) if soc is None else soc
    full_v = ocv_grid(cell)[0][-1]
    is_cold = abs(float(temperature[0]) - REFERENCE_C) > COLD_K
    if soc is None and is_cold and abs(full_v - load.start_v) < FULL_TOLERANCE_V * cell.cell.series_count:
        first_soc = 1.0
    return Run(load, first_soc - load.discharged_ah / cell.cell.capacity_ah, temperature)


def _resistance_scale(runs: list[Run], cell: CellModel) -> float:
    """Return the scale of the resistances [ohm]: the median of the current steps, or a typical value without steps."""
    steps = [ohm for ohm in (step_resistance(run.load) for run in runs) if ohm is not None]
    return float(np.median(steps)) if steps else TYPICAL_DROP_V * cell.cell.series_count / cell.cell.capacity_ah


def _equations_of(runs: list[Run], cell: CellModel) -> list[NormalEquations]:
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


def _recounted(runs: list[Run], cell: CellModel, work: WorkCounter, *, refine_ocv: bool) -> list[Run]:
    """Return the captures with their counted charge rescaled so that knees of voltage and OCV coincide."""
    for _ in range(COUNT_PASSES):
        miscounts = _Candidate(runs, _equations_of(runs, cell), cell, refine_ocv=refine_ocv).miscounts()
        runs = [run.recounted(more) for run, more in zip(runs, miscounts, strict=True)]
        work.part(REGRESSION_WORK * sum(run.soc.size for run in runs))(1.0)
    return runs


def _wrong_temperature(load: CleanCapture, temperature_c: float | None) -> list[str]:
    temperature = temperature_of(load, REFERENCE_C if temperature_c is None else temperature_c)
    if temperature.min() >= MIN_CELL_C and temperature.max() <= MAX_CELL_C:
        return []
    measured = f"temperature_c runs from {temperature.min():.1f} to {temperature.max():.1f}"
    return [f"{load.name}: {measured}, but cells are between {MIN_CELL_C:g} and {MAX_CELL_C:g} C"]


def _temperature_range(runs: list[Run]) -> tuple[float, float]:
    """Return the ``PERCENTILES`` of the temperatures of captures [C]."""
    low_c, high_c = np.percentile(np.concatenate([run.temperature_c for run in runs]), PERCENTILES)
    return round(float(low_c), 1), round(float(high_c), 1)


def _at_nodes(ladder: Ladder) -> Floats:
    """Return the weak and strong part at ``SOC_NODES``, shape (2, RESISTANCES, SOC_NODES.size) [ohm]."""
    parts = ladder.weak_ohm, ladder.strong_ohm
    return np.array([[np.interp(SOC_NODES, ladder.soc, ohm) for ohm in part] for part in parts])


def _weak_share_of(ladder: Ladder) -> Floats:
    """Return the fraction of each resistance with the weak temperature dependence, at ``SOC_NODES``."""
    weak, strong = _at_nodes(ladder)
    return np.where(weak + strong > 0.0, weak / np.maximum(weak + strong, 1e-12), weak_share(SOC_NODES))


def _ocv_error(cell: CellModel) -> Floats:
    """Return the std of the given OCV at ``EVEN_SOC`` [V]."""
    if isinstance(cell.ocv, TableOcv) and cell.ocv.error_v is not None:
        return np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.error_v)
    slope_v = np.interp(EVEN_SOC, np.linspace(0.0, 1.0, ocv_grid(cell)[1].size), ocv_grid(cell)[1])
    return np.hypot(CURVE_ERROR_V * cell.cell.series_count, CURVE_ERROR_SOC * slope_v)


def _curve_error(cell: CellModel) -> Floats:
    """Return the std of the OCV curve at ``EVEN_SOC`` [V], without the error of the hysteresis.

    Captures of drives are discharges. With the error of the hysteresis in the prior, the fit would correct the curve by
    that error, and the correction would have the wrong sign in charges.
    """
    error_v = _ocv_error(cell)
    if not isinstance(cell.ocv, TableOcv) or cell.ocv.hysteresis_v is None:
        return error_v
    hysteresis_v = REST_SHARE_STD * np.interp(EVEN_SOC, cell.ocv.soc, cell.ocv.hysteresis_v)
    square_v2: Floats = np.maximum(error_v**2 - hysteresis_v**2, (PAIR_V * cell.cell.series_count) ** 2)
    return np.sqrt(square_v2)


def _per_kelvin(cell: CellModel) -> tuple[float, ...] | None:
    return cell.ocv.per_kelvin_v if isinstance(cell.ocv, TableOcv) else None


def _corrected_ocv(cell: CellModel, fit: LadderFit, *, entropy: bool) -> TableOcv:
    """Return the corrected OCV as an increasing table with the hysteresis and error columns of the cell."""
    given = cell.ocv if isinstance(cell.ocv, TableOcv) else None
    soc = np.linspace(0.0, 1.0, round(1.0 / OCV_STEP) + 1)
    grid_v = ocv_grid(cell)[0]
    slope = MIN_SLOPE_V * cell.cell.series_count * soc
    corrected_v = np.interp(soc, np.linspace(0.0, 1.0, grid_v.size), grid_v) + correction_at(soc) @ fit.correction
    per_kelvin_v = linear_interpolation_matrix(soc, KELVIN_NODES) @ fit.per_kelvin_v if entropy else None
    if given is not None and given.per_kelvin_v is not None:
        known_v = np.interp(soc, given.soc, given.per_kelvin_v)
        per_kelvin_v = known_v if per_kelvin_v is None else per_kelvin_v + known_v
    hysteresis_v = None if given is None or given.hysteresis_v is None else given.hysteresis_v
    return TableOcv(
        form="table",
        soc=_tuple(soc),
        ocv_v=_tuple(np.maximum.accumulate(corrected_v - slope) + slope),
        error_v=_tuple(np.interp(soc, EVEN_SOC, _ocv_error(cell))),
        hysteresis_v=None if hysteresis_v is None or given is None else _tuple(np.interp(soc, given.soc, hysteresis_v)),
        per_kelvin_v=None if per_kelvin_v is None else _tuple(per_kelvin_v),
    )


def _rms(cell: CellModel, run: Run) -> float:
    """Return the RMS error of the cell's voltage on a capture, weighted by time and scaled to 25 C [V]."""
    grid_v = ocv_grid(cell)[0]
    e_o = np.interp(run.soc, np.linspace(0.0, 1.0, grid_v.size), grid_v)
    error_v = run.load.voltage_v - e_o + overpotential(cell, run.load_with_temperature, run.soc)
    weight = np.clip(np.diff(run.load.time_s, append=run.load.time_s[-1]), 0.0, MAX_STEP_S)
    weight *= (run.soc > MIN_RMS_SOC) / arrhenius(0.5 * STRONG_J, run.temperature_c) ** 2
    return float(np.sqrt((weight * error_v**2).sum() / max(weight.sum(), 1e-12)))


def _geometric_mean(scores: Floats) -> float:
    """Return the geometric mean, in which a capture with a high score for every cell does not dominate."""
    finite = scores[np.isfinite(scores)]
    return float(np.exp(np.log(finite).mean())) if finite.size else float("nan")


def _worse_replays(outcome: Identification) -> str:
    """Return the message on replays that get worse, with the scores of each capture."""
    lines = [
        f"{c.name}: {c.score_before:.2f} before, {c.score_after:.2f} after"
        for c in outcome.captures
        if np.isfinite(c.score_after)
    ]
    return (
        "replays that start in mid-load get worse, their interval score (smaller is better) goes from "
        f"{outcome.score_before:.2f} to {outcome.score_after:.2f} % of SOC; nothing is written: keep the cell file, or give "
        f"captures with more typical loads\n" + "\n".join(lines)
    )


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
