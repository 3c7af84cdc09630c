"""Calibration of a cell: capacity, open-circuit voltage with hysteresis, resistances, and a validation.

These are the steps of the commands ``capacity``, ``ocv``, ``identify`` and ``validate``. The first fit omits the data that are
held back, on which it is then validated. The second fit uses all captures, and is the result.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.automatic.capacity_estimate import CapacityEstimate, estimate_capacity
from bms_estimator.calibration.automatic.given_values import capacity_warnings, chemistry_warnings, unproven_starts
from bms_estimator.calibration.automatic.hold_back import Split, hold_back, use_all
from bms_estimator.calibration.automatic.model_fit import FittedModel, ModelFitter
from bms_estimator.calibration.automatic.recognition import RecognizedCapture, recognize
from bms_estimator.calibration.ocv.source import ExternalCurve
from bms_estimator.calibration.soc_errors import soc_errors
from bms_estimator.calibration.validate import Validation, validate
from bms_estimator.calibration.verdict import Run, Verdict, coverage, judge, voltage_errors
from bms_estimator.model.cell import CellModel, with_capacity
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.pack.pack import new_pack
from bms_estimator.settings.pack import Settings

MAX_FULL_DEVIATION_V = 0.45
"""Maximum difference between the highest voltages of captures of one cell [V]. It allows the 0.31 V between a full LFP cell at rest
(3.34 V) and at the end of a charge (3.65 V), but not the difference between chemistries: full cells have 2.7 V (LTO), 3.6 V (LFP)
or 4.2 V (with cobalt, nickel or manganese)."""

Report = Callable[[float, str], None]
"""Function that receives the finished fraction of the work, 0..1, and the name of the present step."""


def ignore_report(_fraction: float, _step: str) -> None:
    """Ignore the progress."""


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Attributes:
        model: Model fitted to all captures; if that fit finds no resistances, the model without the data held back.
        capacity: Capacity that SOC was counted against.
        captures: The captures, and what each determines.
        is_ocv_measured: True if low-rate curves, rests of some minutes, or given curves determine the OCV; False if it is that of the
            given cell, or an estimate from short rests.
        has_held_back_data: True if the data of the validation were held back from the fit.
        validation_data: Sentence that names the data of the validation.
        validations: Validation on the data that were held back; without such data, validations on all captures.
        verdict: Verdict on the model.
        warnings: Given values that the captures contradict, and reasons why data are not in the model, or why captures could not
            be validated.
    """

    model: FittedModel
    capacity: CapacityEstimate
    captures: tuple[RecognizedCapture, ...]
    is_ocv_measured: bool
    has_held_back_data: bool
    validation_data: str
    validations: tuple[Validation, ...]
    verdict: Verdict
    warnings: tuple[str, ...]


def calibrate(
    captures: Sequence[Columns],
    given: CellModel,
    *,
    name: str,
    curves: Sequence[ExternalCurve] = (),
    initial_soc: float | None = None,
    report: Report = ignore_report,
) -> Calibration:
    """Calibrate a cell by captures of any kind.

    Args:
        captures: Captures of one cell, or of a pack scaled to one cell.
        given: Cell with the rated capacity, such as a generic cell. It supplies the values that the captures do not determine.
        name: Name of the new cell.
        curves: Open-circuit voltages over SOC that were measured otherwise.
        initial_soc: SOC 0..1 at the first sample of the captures that start at the highest voltage; None: 1 if their first rest
            has the voltage of a full cell, otherwise by that voltage.
        report: Receives the finished fraction of the work and the name of the step.

    Raises:
        UserError: A capture cannot be used, or no capture determines the open-circuit voltage or resistances.
    """
    report(0.0, "capacity")
    capacity = estimate_capacity(captures, given, initial_soc)
    initial_cell = with_capacity(given, capacity.capacity_ah, capacity.relative_std)
    recognized = recognize(captures, initial_cell, initial_soc)
    start_notes = [] if curves else unproven_starts(recognized, given)
    _require_equal_full_voltages(recognized)
    if not curves and not any(each.gives_ocv and each.reaches_full for each in recognized):
        recognized = [replace(each, gives_ocv=False) for each in recognized]
    if not curves:
        _require_usable_capture(recognized, start_notes)
    split = hold_back(recognized)
    fitter = ModelFitter(initial_cell, capacity, curves, name)
    validated_model, model, notes = _fit_both(fitter, split, use_all(recognized), report)
    report(1.0, "validation")
    validations, failures = _validate_all(recognized, model)
    covered = coverage([v for _, v in validations], model.cell) if validations else None  # by all captures
    if split.held_back is not None:
        initial_soc = model.initial_soc(split.held_back)
        validation = validate(
            split.held_back.capture, validated_model.cell, initial_soc=initial_soc, from_s=split.held_back_from_s
        )
        validations = [(split.held_back.capture, validation)]
    if not validations:
        raise UserError("\n".join(failures))
    runs = []
    for capture, validation in validations:
        pack = new_pack(Settings(), validated_model.cell, has_forecasts=False)  # as `validate` and `report` run it
        runs.append(Run(capture.name, validation, soc_errors(pack, capture.rows, validation)))
    errors = voltage_errors([run.validation for run in runs], validated_model.cell)
    contradictions = [
        *chemistry_warnings(given, capacity, model.ocv),
        *capacity_warnings(given, capacity, recognized, errors.low_soc_rms_v),
    ]
    return Calibration(
        model=model,
        capacity=capacity,
        captures=tuple(recognized),
        is_ocv_measured=bool(curves) or any(each.gives_ocv and each.measures_ocv for each in recognized),
        has_held_back_data=split.held_back is not None,
        validation_data=split.sentence,
        validations=tuple(run.validation for run in runs),
        verdict=judge(runs, validated_model.cell, covered),
        warnings=tuple(
            dict.fromkeys([*start_notes, *_undetermined_starts(model, recognized), *contradictions, *notes, *failures])
        ),
    )


def _undetermined_starts(model: FittedModel, captures: Sequence[RecognizedCapture]) -> list[str]:
    """Return the lines on captures whose voltage does not determine their SOC at the start, except those of OCV tests."""
    if model.identification is None:
        return []
    named = [each.capture.name for each in captures if each.is_ocv_test]  # ``unproven_starts`` names them
    return [line for line in model.identification.undetermined_starts if line.partition(":")[0] not in named]


def _require_equal_full_voltages(captures: Sequence[RecognizedCapture]) -> None:
    """Raise UserError if the highest voltages of captures show that the cells have different chemistries.

    Captures that determine the OCV from full contain the full cell. Tests that draw more than their first voltage allows may do
    so, too, if they are of another chemistry. The other captures do not exceed the voltage of the full cell.
    """
    ranges_v = {each.capture.name: np.percentile(each.good["voltage_v"], [1.0, 99.0]) for each in captures}
    from_full = [
        each.capture.name for each in captures if (each.gives_ocv and each.reaches_full) or each.contradicts_start
    ]
    if not from_full:
        return
    low, high = min(from_full, key=lambda name: ranges_v[name][1]), max(ranges_v, key=lambda name: ranges_v[name][1])
    if ranges_v[high][1] - ranges_v[low][1] > MAX_FULL_DEVIATION_V:
        lines = [f"\n{name}: {ranges_v[name][0]:.2f} to {ranges_v[name][1]:.2f} V per cell" for name in (low, high)]
        raise UserError(
            "the captures are not of one cell, because their voltages at full differ; calibrate each cell by itself"
            + "".join(lines)
        )


def _require_usable_capture(captures: Sequence[RecognizedCapture], start_notes: Sequence[str]) -> None:
    """Raise UserError if no capture determines anything."""
    if not any(each.gives_ocv or each.gives_resistances for each in captures):
        kinds = "".join(
            f"\n{line}" for line in (*(f"{each.capture.name}: {each.kind}" for each in captures), *start_notes)
        )
        raise UserError(
            "no capture determines the OCV or resistances: give a slow discharge from full to empty, or a load with at "
            f"least six rests of some minutes{kinds}"
        )


def _fit_both(
    fitter: ModelFitter, split: Split, all_data: Split, report: Report
) -> tuple[FittedModel, FittedModel, list[str]]:
    """Return the model without the data held back, the model of all data, and a note if the first replaces the second."""
    fits = 1 if split.held_back is None else 2  # they take almost the whole time

    def fit(data: Split, step: str, finished_fits: int) -> FittedModel:
        report(finished_fits / fits, step)
        return fitter.fit(data, lambda fraction: report((finished_fits + fraction) / fits, step))

    validated_model = fit(split, "model without the data held back", 0)
    if split.held_back is None:
        return validated_model, validated_model, []
    model = fit(all_data, "model of all data", 1)
    if model.identification is None and validated_model.identification is not None:
        note = f"the model was fitted without the data held back, because with all data {model.reason}"
        return validated_model, validated_model, [note]
    return validated_model, model, []


def _validate_all(
    captures: Sequence[RecognizedCapture], model: FittedModel
) -> tuple[list[tuple[Columns, Validation]], list[str]]:
    """Validate the model on all captures; return each with its validation, and the reasons why some cannot be validated."""
    validations, warnings = [], []
    for each in captures:
        try:
            validation = validate(each.capture, model.cell, initial_soc=model.initial_soc(each))
            validations.append((each.capture, validation))
        except UserError as error:
            warnings.append(str(error))
    return validations, warnings
