"""Calibration of a1..a15 by the procedure of the thesis "Adaptive Estimation of Li-ion Battery Model Parameters".

a1..a15 are the coefficients of the elements of Chen and Mora's model: three for each of R_ts, R_tl, C_ts, C_tl and R_s
as functions of SOC, (2.5)-(2.9) of the thesis. Step 1, the fit of the open-circuit voltage to rests, is the command `ocv`;
its result is part of the given cell. Step 2 runs the adaptive observer (Algorithm 1) and averages its parameters by (3.19),
which gives a1..a12. Step 3 computes R_s by (4.2) and fits its coefficients a13..a15. The result is scored by the replays
of `identify`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.cleaning.capture_checks import capture_contradictions, initial_soc
from bms_estimator.calibration.cleaning.clean_capture import CleanCapture, clean_capture, remove_glitches
from bms_estimator.calibration.elements.cell_from_fit import MIN_ERROR_V
from bms_estimator.calibration.elements.identify import EQUAL_SCORE_RATIO
from bms_estimator.calibration.elements.replay_score import interval_score
from bms_estimator.calibration.thesis.adaptive_run import AdaptiveRun, adaptive_run
from bms_estimator.calibration.thesis.prediction import predict
from bms_estimator.calibration.thesis.series_resistance import (
    LOWEST_SOC,
    SeriesResistanceFit,
    fit_series_resistance,
    mean_of,
    series_resistance,
)
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import BRANCHES_STD, ROOM_C, SOC_GRID, ladder_of_branches
from bms_estimator.kernels.cell_model.rc_ladder import weak_share
from bms_estimator.model.arrays import Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import Bounds, Ladder, Resistance
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.settings.observer import ObserverSettings


def printed_bounds(cell: CellModel) -> dict[str, Bounds]:
    """Return the bounds and initial values of a1..a12 of Table 10, scaled from the pack of the thesis to ``cell``.

    Resistances scale with the number of cells in series over the capacity, capacitances with its inverse. Exponents are
    not scaled. No capture influences these bounds.
    """
    printed = load_cell("thunder_power_6s")
    ohm_ratio = (cell.cell.series_count * printed.cell.capacity_ah) / (
        printed.cell.series_count * cell.cell.capacity_ah
    )
    scaled_bounds = {}
    for name, bounds in printed.adaptation.items():
        element, coefficient = divmod(int(name[1:]) - 1, 3)
        # each element has an amplitude, an exponent (1) and an offset; elements 2 and 3 are capacitances
        factor = 1.0 if coefficient == 1 else 1.0 / ohm_ratio if element in (2, 3) else ohm_ratio
        table = bounds.model_dump()
        scaled = {key: factor * table[key] for key in ("upper", "lower", "initial") if table[key] is not None}
        scaled_bounds[name] = Bounds.model_validate(table | scaled)
    return scaled_bounds


VOLTAGE_STEP_V = 1e-3
"""Assumed resolution of a capture's voltage [V]."""


@dataclass(frozen=True)
class CaptureWithSoc:
    """Samples of a capture without glitches, and its initial SOC.

    Attributes:
        samples: Dtype ``SAMPLE``.
        soc: SOC at the first sample, 0..1.
    """

    samples: SampleBlock
    soc: float


@dataclass(frozen=True)
class AdaptedElements:
    """Result of steps 2 and 3.

    Attributes:
        run: Step 2, Algorithm 1 over one capture with the averages (3.19).
        r_s: Step 3, a13..a15 fitted to (4.2) over all captures.
    """

    run: AdaptiveRun
    r_s: SeriesResistanceFit

    @property
    def a(self) -> Floats:
        """a1..a15 at index 1..15. Shape (16,)."""
        a = self.run.average.copy()
        a[13:16] = self.r_s.a
        return a


def steps_2_and_3(cell: CellModel, captures: Sequence[CaptureWithSoc], lowest_soc: float) -> AdaptedElements:
    """Adapt a1..a12 to the capture with the smallest mean current, then fit a13..a15 to all captures.

    Algorithm 1 needs a very small current; (4.2) needs several currents.

    Args:
        cell: Capacity, open-circuit voltage, and the bounds of (3.18).
        captures: Captures that start from rest.
        lowest_soc: SOC below which (4.2) is not evaluated, because the open-circuit voltage is uncertain there.

    Raises:
        UserError: No good sample, no current, or too small a range of SOC for a13..a15.
    """
    smallest = min(captures, key=lambda capture: float(np.abs(capture.samples["current_a"]).mean()))
    observer = Estimator(
        cell,
        ObserverSettings(law="improved"),
        identifier=None,
        voltage_resolution_v=VOLTAGE_STEP_V,
        initial_soc=smallest.soc,
    )
    run = adaptive_run(observer, smallest.samples)
    predictions = [predict(cell, c.samples, c.soc, a=run.average, lowest_soc=lowest_soc) for c in captures]
    curve = mean_of([series_resistance(cell, prediction) for prediction in predictions])
    return AdaptedElements(run, fit_series_resistance(curve, lowest_soc))


@dataclass(frozen=True)
class AdaptedCapture:
    """Errors and scores of one capture.

    Attributes:
        name: Name of the capture.
        initial_soc: SOC at the first sample, 0..1.
        voltage_rms_v: RMS error of the voltage, open loop, above SOC 0.1 [V].
        score_before: Interval score of replays with the given cell [%]; NaN for a capture that is too short.
        score_after: Interval score with the adapted cell [%].
        held_back: True if ``score_after`` is the score with a cell adapted to the other captures only.
    """

    name: str
    initial_soc: float
    voltage_rms_v: float
    score_before: float
    score_after: float
    held_back: bool


@dataclass(frozen=True)
class Adaptation:
    """An adapted cell.

    Attributes:
        cell: The cell with a1..a15 and an RC ladder that is equivalent to these elements.
        steps: Result of steps 2 and 3 over all captures.
        captures: Errors and scores of each capture, in the order given.
        score_before: Geometric mean of the interval scores with the given cell [%]; NaN when no capture is long enough.
        score_after: Geometric mean with the adapted cell [%].
    """

    cell: CellModel
    steps: AdaptedElements
    captures: tuple[AdaptedCapture, ...]
    score_before: float
    score_after: float


def adapt(captures: Sequence[Columns], cell: CellModel, *, soc: float | None = None) -> Adaptation:
    """Estimate a1..a15 by the thesis's procedure.

    If the cell file has no bounds for the adaptive law (3.18), the bounds of Table 10 of the thesis are used, scaled
    to the cell's capacity.

    Args:
        captures: Raw samples, rows of dtype ``SAMPLE``; each starts from rest.
        cell: Capacity, limits, OCV, and optional bounds of a1..a12.
        soc: SOC 0..1 at the first sample of each capture; None: from its first rest.

    Raises:
        UserError: A capture contradicts the cell, a1..a15 cannot be estimated, or the replays get worse.
    """
    cleaned = [clean_capture(capture.name, capture.rows, cell) for capture in captures]
    socs = [initial_soc(clean, cell) if soc is None else soc for clean in cleaned]
    contradictions = [
        line
        for clean, start_soc in zip(cleaned, socs, strict=True)
        for line in capture_contradictions(clean, cell, start_soc)
    ]
    if contradictions:
        raise UserError("\n".join(contradictions))
    # the observer runs over all samples except glitches; the cleaned captures lack more samples
    captures_with_soc = [
        CaptureWithSoc(remove_glitches(capture.rows, capture.name), start_soc)
        for capture, start_soc in zip(captures, socs, strict=True)
    ]
    steps, adapted = _adapted_cell(cell, captures_with_soc)
    scored_captures = tuple(
        _scored_capture(cell, adapted, cleaned, captures_with_soc, j) for j in range(len(captures_with_soc))
    )
    before = _geometric_mean([capture.score_before for capture in scored_captures])
    after = _geometric_mean([capture.score_after for capture in scored_captures])
    if after > EQUAL_SCORE_RATIO * before:
        raise UserError(
            f"nothing is written: replays started in mid-load get worse, their interval score (smaller is better) goes "
            f"from {before:.2f} to {after:.2f} % of SOC; use `identify`, or give captures of more currents"
        )
    return Adaptation(adapted, steps, scored_captures, before, after)


def _adapted_cell(cell: CellModel, captures_with_soc: Sequence[CaptureWithSoc]) -> tuple[AdaptedElements, CellModel]:
    """Return the result of steps 2 and 3, and the cell with that result."""
    bounded = cell.model_copy(update={"adaptation": printed_bounds(cell) | cell.adaptation})
    steps = steps_2_and_3(bounded, captures_with_soc, LOWEST_SOC)
    return steps, _with_elements(cell, steps, captures_with_soc)


def _with_elements(cell: CellModel, steps: AdaptedElements, captures_with_soc: Sequence[CaptureWithSoc]) -> CellModel:
    """Return the cell with a1..a15 and an equivalent RC ladder with the errors of the fit."""
    a, update = steps.a, dict[str, object]()
    # index of each element's first coefficient; a[0] is unused, so that a1 is a[1]
    for name, first in (("r_ts", 1), ("r_tl", 4), ("c_ts", 7), ("c_tl", 10)):
        section = getattr(cell, name)
        keys = tuple(type(section).model_fields)
        update[name] = section.model_copy(update=dict(zip(keys, a[first : first + 3].tolist(), strict=True)))
    update["r_s"] = Resistance.model_validate(steps.r_s.element.model_dump())
    with_branches = cell.model_copy(update=update | {"adaptation": {}, "ladder": None})
    # each resistance is the sum of a part with weak and a part with strong temperature dependence
    ohm, weak_fraction = ladder_of_branches(with_branches).T, weak_share(SOC_GRID)
    errors = np.concatenate(
        [predict(with_branches, s.samples, s.soc, lowest_soc=LOWEST_SOC).error_v for s in captures_with_soc]
    )
    ladder = Ladder(
        soc=tuple(SOC_GRID.tolist()),
        weak_ohm=_rows(weak_fraction * ohm),
        strong_ohm=_rows((1.0 - weak_fraction) * ohm),
        std=BRANCHES_STD,
        error_v=max(float(np.sqrt(np.mean(errors**2))), MIN_ERROR_V),
        temperature_c=_temperatures(captures_with_soc),
    )
    return with_branches.model_copy(update={"ladder": ladder})


def _scored_capture(
    cell: CellModel, adapted: CellModel, cleaned: list[CleanCapture], captures_with_soc: list[CaptureWithSoc], j: int
) -> AdaptedCapture:
    """Return the errors and scores of capture ``j``. If there are other captures, the cell is adapted only to these."""
    clean, capture = cleaned[j], captures_with_soc[j]
    others = [s for k, s in enumerate(captures_with_soc) if k != j]
    adapted_to_others = _adapted_cell(cell, others)[1] if others else adapted
    soc_of_samples = capture.soc - clean.discharged_ah / cell.cell.capacity_ah
    error_v = predict(adapted, capture.samples, capture.soc, lowest_soc=LOWEST_SOC).error_v
    return AdaptedCapture(
        name=clean.name,
        initial_soc=capture.soc,
        voltage_rms_v=float(np.sqrt(np.mean(error_v**2))),
        score_before=interval_score(cell, clean, soc_of_samples),
        score_after=interval_score(adapted_to_others, clean, soc_of_samples),
        held_back=bool(others),
    )


def _temperatures(captures_with_soc: Sequence[CaptureWithSoc]) -> tuple[float, float]:
    """Return the lowest and highest temperature of the captures [C]; ``ROOM_C`` without a sensor."""
    temperature_c = np.concatenate([s.samples["temperature_c"] for s in captures_with_soc])
    measured_c = temperature_c[np.isfinite(temperature_c)]
    return (float(measured_c.min()), float(measured_c.max())) if measured_c.size else ROOM_C


def _geometric_mean(scores: Sequence[float]) -> float:
    """Return the geometric mean of the finite scores; NaN if there are none."""
    finite = [score for score in scores if np.isfinite(score)]
    return float(np.exp(np.mean(np.log(finite)))) if finite else float("nan")


def _rows(ohm: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, ohm.tolist()))
