"""Identification of a cell from captures: RC ladder, a1..a15 of two equivalent RC pairs, corrected OCV.

``ladder_fit`` fits the resistances. The result is scored by replays of the estimator that start in mid-load, with the
given and with the identified cell. If other captures at about the temperature of a capture were given, the replays of
that capture use a fit without it (hold-out).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import capture_contradictions, without_excitation
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.cleaning.start_soc import undetermined_start
from bms_estimator.calibration.elements.candidate import Candidate, equations_of, geometric_mean
from bms_estimator.calibration.elements.capture_run import Run, make_run, wrong_temperature
from bms_estimator.calibration.elements.identification import Identification
from bms_estimator.calibration.elements.replay_score import interval_score
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress, WorkCounter, no_progress

COUNT_PASSES = 3
"""Number of fits that refine the miscount of each capture. Iteration is needed because the OCV is nonlinear at a
knee."""
REGRESSION_WORK = 0.5
"""Time for the normal equations of a capture, relative to the time for the replays of the capture."""
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
        initial_socs: SOC 0..1 at the first sample of some captures by name, which precedes ``initial_soc``.
        temperature_c: Temperature of captures without a sensor [C]; None: 25 C.
        progress: Receives the finished fraction of the work.

    Raises:
        UserError: No capture has excitation, a capture contradicts the cell (sign of the current, capacity, OCV), a
            temperature is implausible, or replays get worse.
    """
    cleaned = [clean_capture(capture.name, capture.rows, cell) for capture in captures]
    loads = [load for load in cleaned if not without_excitation(load, cell)]
    # without any load, the checks below report the missing excitation
    runs = [make_run(load, cell, initial_socs.get(load.name, initial_soc), temperature_c) for load in loads or cleaned]
    contradictions = [line for run in runs for line in capture_contradictions(run.load, cell, float(run.soc[0]))]
    contradictions += [line for load in loads for line in wrong_temperature(load, temperature_c)]
    if contradictions:
        raise UserError("\n".join(contradictions))
    variants = (False, True) if refine_ocv else (False,)  # with the given OCV, with a corrected OCV
    samples = sum(run.soc.size for run in runs)
    work = WorkCounter(progress, (1 + len(variants) + REGRESSION_WORK * COUNT_PASSES) * samples)
    runs = _recounted(runs, cell, work, refine_ocv=refine_ocv)
    left_out = tuple(load.name for load in cleaned if without_excitation(load, cell))
    equations = equations_of(runs, cell)
    candidates = [Candidate(runs, equations, cell, refine_ocv=refine) for refine in variants]
    before = np.array([interval_score(cell, run.load, run.soc, work.part(run.soc.size)) for run in runs])
    after = [_scores(candidate, runs, work) for candidate in candidates]
    best = len(after) - 1  # the last candidate, if no capture has a score
    if np.isfinite(before).any():
        # scores of captures that are not held back favor the variant with more unknowns
        held_back = [j for j in range(len(runs)) if candidates[0].is_held_back(j)]
        given, refined = (
            geometric_mean(scores[held_back] if held_back else scores) for scores in (after[0], after[-1])
        )
        best = int((EQUAL_SCORE_RATIO if held_back else 1.0) * refined < given)  # index in ``candidates``
    outcome = candidates[best].outcome(before, after[best], left_out)
    unknown = [load for load in loads if initial_soc is None and load.name not in initial_socs]
    undetermined = tuple(
        f"{load.name}: give the SOC at the start (--soc), because {text}"
        for load in unknown
        if (text := undetermined_start(load, cell))
    )
    if outcome.score_after > EQUAL_SCORE_RATIO * outcome.score_before:
        raise UserError("\n".join([_worse_replays(outcome), *undetermined]))
    return replace(outcome, undetermined_starts=undetermined)


def _scores(candidate: Candidate, runs: list[Run], work: WorkCounter) -> Floats:
    """Return the score of each capture's replays [%], by a fit without the capture if it is held back."""
    return np.array(
        [
            interval_score(candidate.cell_for(j), run.load, run.soc, work.part(run.soc.size))
            for j, run in enumerate(runs)
        ]
    )


def _recounted(runs: list[Run], cell: CellModel, work: WorkCounter, *, refine_ocv: bool) -> list[Run]:
    """Return the captures with their counted charge rescaled so that knees of voltage and OCV coincide."""
    for _ in range(COUNT_PASSES):
        miscounts = Candidate(runs, equations_of(runs, cell), cell, refine_ocv=refine_ocv).miscounts()
        runs = [run.recounted(more) for run, more in zip(runs, miscounts, strict=True)]
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
        "replays that start in mid-load get worse, their interval score (smaller is better) goes from "
        f"{outcome.score_before:.2f} to {outcome.score_after:.2f} % of SOC; nothing is written: keep the cell file, or give "
        f"captures with more typical loads\n" + "\n".join(lines)
    )
