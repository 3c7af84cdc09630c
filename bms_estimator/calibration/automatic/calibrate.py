"""Calibration of a cell: capacity, open-circuit voltage with hysteresis, resistances, and a validation.

It takes the same steps as the commands ``capacity``, ``ocv``, ``identify`` and ``validate``. The model is fitted twice: without
the data that are held back, to validate it, and then to all captures. The second fit is the result.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bms_estimator.calibration.automatic.capacity_estimate import CapacityEstimate, estimate_capacity
from bms_estimator.calibration.automatic.hold_back import Split, hold_back, use_all
from bms_estimator.calibration.automatic.recognition import RecognizedCapture, recognize
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.elements.identify import Identification, identify
from bms_estimator.calibration.elements.identify import initial_soc as soc_of_first_rest
from bms_estimator.calibration.elements.replay_score import MIN_SOC, SETTLING_S
from bms_estimator.calibration.ocv.sources import ExternalCurve, Recording
from bms_estimator.calibration.ocv_cell import OcvCell, determine_ocv
from bms_estimator.calibration.validate import Validation, validate
from bms_estimator.calibration.verdict import SocErrors, Verdict, coverage, judge, voltage_errors
from bms_estimator.estimator import Estimator
from bms_estimator.model.cell import CellModel, with_capacity
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress
from bms_estimator.model.sample import SAMPLE

Report = Callable[[float, str], None]
"""Function that receives the finished fraction of the work, 0..1, and the name of the present step."""


def ignore_report(_fraction: float, _step: str) -> None:
    """Ignore the progress."""


@dataclass(frozen=True)
class FittedModel:
    """Cell model fitted to captures.

    Attributes:
        cell: The cell model.
        ocv: Fit of the open-circuit voltage; None if no capture determines it, so that the given cell's OCV is used.
        identification: Fit of the resistances; None if those of the most similar generic cell are used.
        reason: Reason why the resistances are generic; empty if they were identified.
    """

    cell: CellModel
    ocv: OcvCell | None
    identification: Identification | None
    reason: str


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Attributes:
        model: Model fitted to all captures. If its replays are worse, the model of the validation.
        capacity: Capacity that SOC was counted against.
        captures: The captures, and what each determines.
        has_held_back_data: True if the data of the validation were held back from the fit.
        validation_data: Sentence that names the data of the validation.
        validations: Validation on the data that were held back; without such data, validations on all captures.
        verdict: Verdict on the model.
        warnings: Reasons why data are not in the model, or why captures could not be validated.
    """

    model: FittedModel
    capacity: CapacityEstimate
    captures: tuple[RecognizedCapture, ...]
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
    temperature_c: float | None = None,
    report: Report = ignore_report,
) -> Calibration:
    """Calibrate a cell by captures of any kind.

    Args:
        captures: Captures of one cell, scaled to one cell. Those that determine the open-circuit voltage start with a full
            cell.
        given: Cell with the rated capacity, such as a generic cell. It supplies what the captures do not determine.
        name: Name of the new cell.
        curves: Open-circuit voltages over SOC that were measured otherwise.
        temperature_c: Temperature of captures without a sensor [°C]; None: 25 °C.
        report: Receives the finished fraction of the work and the name of the step.

    Raises:
        UserError: A capture cannot be used, or no capture determines the open-circuit voltage or resistances.
    """
    report(0.0, "capacity")
    capacity = estimate_capacity(captures, given)
    initial_cell = with_capacity(given, capacity.capacity_ah)
    recognized = tuple(recognize(capture, initial_cell) for capture in captures)
    if not curves:
        _require_usable_capture(recognized)
    split = hold_back(recognized)

    fits = 1 if split.held_back is None else 2  # they take almost the whole time

    def fit(fitted: Split, step: str, done: int) -> FittedModel:
        def progress(fraction: float) -> None:
            report((done + fraction) / fits, step)

        progress(0.0)
        return _fit(fitted, initial_cell, capacity, curves, name, temperature_c, progress)

    validated = fit(split, "model without the data held back", 0)
    model, notes = validated, []
    if split.held_back is not None:
        model = fit(use_all(recognized), "model of all data", 1)
        if model.identification is None and validated.identification is not None:
            notes = [f"the model is that without the data held back, because with all data {model.reason}"]
            model = validated
    report(1.0, "validation")
    of_captures, failures = _validate_all(recognized, model)
    validations, soc_errors = of_captures, None
    if split.held_back is not None:
        held_back, initial_soc = split.held_back.capture, _initial_soc(split.held_back, model)
        validations = [validate(held_back, validated.cell, initial_soc=initial_soc, from_s=split.held_back_from_s)]
        soc_errors = _soc_errors(validations[0], validated.cell)
    if not validations:
        raise UserError("\n".join(failures))
    # the model covers the operating ranges of all captures, not only of the data held back
    covered = coverage(of_captures or validations, model.cell)
    return Calibration(
        model=model,
        capacity=capacity,
        captures=recognized,
        has_held_back_data=split.held_back is not None,
        validation_data=split.sentence,
        validations=tuple(validations),
        verdict=judge(voltage_errors(validations, validated.cell), covered, soc_errors),
        warnings=(*notes, *failures),
    )


def _require_usable_capture(captures: Sequence[RecognizedCapture]) -> None:
    """Raise UserError if no capture determines anything."""
    if not any(each.gives_ocv or each.gives_resistances for each in captures):
        kinds = "".join(f"\n{each.capture.name}: {each.kind}" for each in captures)
        raise UserError(
            "no capture determines the OCV or resistances: give a slow discharge from full to empty, or a load with at "
            f"least six rests of some minutes{kinds}"
        )


def _fit(
    split: Split,
    initial_cell: CellModel,
    capacity: CapacityEstimate,
    curves: Sequence[ExternalCurve],
    name: str,
    temperature_c: float | None,
    progress: Progress,
) -> FittedModel:
    """Fit the open-circuit voltage, and then the resistances."""
    ocv, cell = None, initial_cell
    if split.ocv or curves:
        ocv = determine_ocv(
            [Recording(each.capture.name, each.capture.rows) for each in split.ocv],
            curves,
            name=name,
            capacity_ah=None if capacity.from_slow_discharge else capacity.capacity_ah,
            series_count=1,
        )
        cell = ocv.cell
    if not split.resistances:
        return FittedModel(cell, ocv, None, "no capture has a current above 0.1 C")
    try:
        identification = identify(
            [each.capture for each in split.resistances], cell, temperature_c=temperature_c, progress=progress
        )
    except UserError as error:
        if ocv is None:
            raise
        fault = str(error).splitlines()[0].partition(";")[0]  # the rest is a remedy
        return FittedModel(cell, ocv, None, fault)
    named = identification.cell.model_copy(update={"cell": identification.cell.cell.model_copy(update={"name": name})})
    return FittedModel(named, ocv, identification, "")


def _initial_soc(recognized: RecognizedCapture, model: FittedModel) -> float:
    """Return the SOC at the first sample of a capture, from the identification or else from the capture's first rest."""
    if model.identification is not None:
        for fit in model.identification.captures:
            if fit.name == recognized.capture.name:
                return fit.initial_soc
    return soc_of_first_rest(clean_capture(recognized.capture.name, recognized.good, model.cell), model.cell)


def _validate_all(captures: Sequence[RecognizedCapture], model: FittedModel) -> tuple[list[Validation], list[str]]:
    """Validate the model on all captures; return also the reasons why some cannot be validated."""
    validations, warnings = [], []
    for each in captures:
        try:
            validations.append(validate(each.capture, model.cell, initial_soc=_initial_soc(each, model)))
        except UserError as error:
            warnings.append(str(error))
    return validations, warnings


def _soc_errors(validation: Validation, cell: CellModel) -> SocErrors | None:
    """Return the errors of an estimator that initializes its SOC from the voltage; None if the capture is too short."""
    samples = np.zeros(validation.time_s.size, dtype=SAMPLE)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c"):
        samples[name] = getattr(validation, name)
    trace = Estimator(cell).run(samples)
    true_soc = np.interp(trace["time_s"], validation.time_s, validation.soc)
    scored = (trace["time_s"] >= SETTLING_S) & (true_soc >= MIN_SOC)
    if not scored.any():
        return None
    error = (trace["soc"] - true_soc)[scored]
    within = np.abs(error) <= 2.0 * trace["soc_std"][scored]
    return SocErrors(rms=float(np.sqrt(np.mean(error**2))), within_band=float(within.mean()))
