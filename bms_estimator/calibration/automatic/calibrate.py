"""Calibration of a cell: capacity, open-circuit voltage with hysteresis, resistances, and a validation.

These are the steps of the commands ``capacity``, ``ocv``, ``identify`` and ``validate``. The first fit omits the data that are
held back, on which it is then validated. The second fit uses all captures, and is the result. Captures that contradict the
given chemistry or rated capacity give warnings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.automatic.model_fit import FittedModel, ModelFitter, Split, hold_back, use_all
from bms_estimator.calibration.automatic.recognition import (
    CapacityEstimate,
    RecognizedCapture,
    estimate_capacity,
    largest_swing_ah,
    recognize,
)
from bms_estimator.calibration.cleaning.capture_checks import StartOrigin
from bms_estimator.calibration.elements.initial_elements import ocv_rms_difference_v
from bms_estimator.calibration.ocv.source import ExternalCurve
from bms_estimator.calibration.ocv.table_fit import NODES
from bms_estimator.calibration.ocv_cell import OcvCell
from bms_estimator.calibration.validate import Validation, soc_errors, validate
from bms_estimator.calibration.verdict import Run, Verdict, coverage, judge, voltage_errors
from bms_estimator.model.cell import CellModel, generic_cells, load_cell, with_capacity
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.pack.pack import new_pack
from bms_estimator.settings.pack import Settings

MIN_CHEMISTRY_DIFFERENCE_V = 0.25
"""Minimum difference of two RMS voltages that causes a warning [V]. The voltages are the RMS differences from the measured OCV of
the given cell and of the nearest generic cell. The difference is at most 0.19 V among LCO, LMO, NCA and NMC. If only one of the
two cells is LFP or LTO, it is at least 0.34 V with a rated capacity up to 12 % too large."""
MIN_LOW_SOC_RMS_V = 0.1
"""Minimum RMS error at low SOC that suggests a wrong capacity, per cell [V]. With the capacity drawn,
a Leaf cell has 31 mV and an NCR18650 cell 71 mV. With a capacity that is 8 % too large, the Leaf cell has 228 mV."""
MIN_DRAWN_FRACTION = 0.8
"""Minimum fraction of the rated capacity that a capture draws if its end may be an empty cell. Cells usually count
as worn out at 80 % of their rated capacity."""


def unproven_starts(captures: Sequence[RecognizedCapture], given: CellModel) -> list[str]:
    """Return a line on each capture that would determine capacity or OCV if its SOC at the first sample were known.

    Args:
        captures: The captures. The SOC of a capture is read from the OCV curve of others that start at a known SOC.
        given: Cell whose OCV gives the SOC of the first rest.
    """
    lines = []
    has_other_curve = any(each.gives_ocv and each.start.is_exact for each in captures)
    for each in captures:
        only_charges = each.gives_ocv and all(branch.charge for branch in each.slow_branches) and each.slow_branches
        if each.start.is_exact or not each.is_ocv_test or only_charges or (has_other_curve and each.gives_ocv):
            continue
        remedy = (
            "the SOC is counted from there"
            if each.gives_ocv and each.reaches_full
            else "it gives neither capacity nor OCV"
        )
        lines.append(
            f"{each.capture.name}: nothing proves that it starts with a full cell: {each.start.reason} of {given.cell.name}; "
            f"{remedy}; if the SOC at the start is known, give --soc"
        )
    return lines


def chemistry_warnings(given: CellModel, capacity: CapacityEstimate, ocv: OcvCell | None) -> list[str]:
    """Return a warning if the measured OCV belongs to another chemistry than the given generic cell.

    There is no warning if the capacity was measured, because the given cell then determines neither capacity nor OCV.
    """
    if ocv is None or capacity.is_measured or given.cell.name not in generic_cells():
        return []
    generic = load_cell(given.cell.name, given.cell.capacity_ah)
    given_v, nearest_v = (ocv_rms_difference_v(cell, NODES, ocv.fit(NODES)) for cell in (generic, ocv.generic))
    if given_v - nearest_v < MIN_CHEMISTRY_DIFFERENCE_V:
        return []
    nearest = ocv.generic.cell.name
    return [f"the measured OCV fits {nearest} better than {generic.cell.name}: check --cell, or cell in [pack]"]


def capacity_warnings(
    given: CellModel, capacity: CapacityEstimate, captures: Sequence[RecognizedCapture], low_soc_rms_v: float
) -> list[str]:
    """Return a warning on a rated capacity that a capture contradicts.

    A slow discharge contradicts it by a much smaller capacity. If the rated capacity is used, the charge of another discharge
    from full may be the true capacity.

    Args:
        given: Cell with the rated capacity.
        capacity: Capacity that SOC was counted against.
        captures: The captures.
        low_soc_rms_v: RMS error of the model at low SOC, per cell [V]; NaN without samples.
    """
    rated_ah = given.cell.capacity_ah
    if capacity.from_slow_discharge and capacity.capacity_ah < MIN_DRAWN_FRACTION * rated_ah:
        percent = 100.0 * capacity.capacity_ah / rated_ah
        text = f"the slow discharge measures {percent:.0f} % of the rated {rated_ah:.4g} Ah"
        return [f"{text}; if it began below full, give the SOC at its start (--soc)"]
    drawn = [
        (largest_swing_ah(each.good), each.capture.name)
        for each in captures
        if each.gives_ocv and each.start.origin is StartOrigin.FULL
    ]
    if not drawn or capacity.capacity_ah != rated_ah or not low_soc_rms_v > MIN_LOW_SOC_RMS_V:
        return []
    drawn_ah, name = max(drawn)
    if drawn_ah < MIN_DRAWN_FRACTION * rated_ah:
        return []
    return [
        f"{name} draws {drawn_ah:.4g} Ah from full; if it ended when the cell was empty, give --capacity {drawn_ah:.4g}"
    ]


MAX_FULL_DEVIATION_V = 0.45
"""Maximum difference between the highest voltages of captures of one cell [V]. It allows the 0.31 V between a full LFP cell at
rest (3.34 V) and at the end of a charge (3.65 V), but not the difference between chemistries: full cells have 2.7 V (LTO), 3.6
V (LFP) or 4.2 V (with cobalt, nickel or manganese)."""

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
        is_ocv_measured: True if low-rate curves, rests of some minutes, or given curves determine the OCV; False if the OCV
            of the given cell is unchanged, or estimated from short rests.
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

    Captures that determine the OCV from full contain the full cell. A test of another chemistry may
    contain it, too, if it draws more than its first voltage allows. The other captures do not exceed the voltage of the full
    cell.
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
    """Return the model without the data held back, the model of all data, and a note if the first is returned for both."""
    fits = 1 if split.held_back is None else 2  # the fits take almost the whole time

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
