"""Fit of a cell model to captures: the open-circuit voltage, then the resistances; and the captures held back from it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.automatic.recognition import CapacityEstimate, RecognizedCapture
from bms_estimator.calibration.cleaning.capture_checks import StartOrigin, initial_soc as soc_of_first_rest
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.elements.identify import Identification, identify
from bms_estimator.calibration.elements.ladder_fit import MIN_SPAN_K
from bms_estimator.calibration.ocv.source import ExternalCurve, Recording
from bms_estimator.calibration.ocv_cell import OcvCell, determine_ocv
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.cell import CellModel, with_capacity, with_name
from bms_estimator.model.charge_count import step_charges_as
from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress

FIT_FRACTION = 0.7
"""Fraction of a capture's charge that the fit uses, if the last part of the capture is held back."""


@dataclass(frozen=True)
class Split:
    """Split of captures into data for the fit and data for the validation.

    Attributes:
        ocv_captures: Captures that determine the open-circuit voltage.
        resistance_captures: Captures that determine the resistances.
        held_back: Capture of the validation; None if no data are held back.
        held_back_from_s: Start of the data that are held back [s], counted from the first good sample of ``held_back``.
        sentence: Sentence that names the data that are held back.
    """

    ocv_captures: tuple[RecognizedCapture, ...]
    resistance_captures: tuple[RecognizedCapture, ...]
    held_back: RecognizedCapture | None = None
    held_back_from_s: float = 0.0
    sentence: str = "No data were held back: these are the errors on the data of the fit."


def use_all(captures: Sequence[RecognizedCapture]) -> Split:
    """Return the split for a fit to all captures.

    Low-rate curves determine the open-circuit voltage at every temperature. Rests do so only near 25 °C, because colder
    rests end before the voltage has relaxed. Therefore only the rests nearest to 25 °C are used.
    """
    temperatures_c = np.nan_to_num([each.temperature_c for each in captures], nan=REFERENCE_C)
    distances_k = np.abs(temperatures_c - REFERENCE_C)
    nearest_k = min((d for each, d in zip(captures, distances_k, strict=True) if each.gives_ocv), default=0.0)
    return Split(
        ocv_captures=tuple(
            each
            for each, distance_k in zip(captures, distances_k, strict=True)
            if each.gives_ocv and (each.slow_branches or distance_k < nearest_k + MIN_SPAN_K)
        ),
        resistance_captures=tuple(each for each in captures if each.gives_resistances),
    )


def hold_back(captures: Sequence[RecognizedCapture]) -> Split:
    """Return the split for a validation.

    A whole capture is held back if the others determine the model without it. The first choice is a capture that
    determines no open-circuit voltage, such as a drive cycle. The second is the capture with the lowest initial voltage,
    because the open-circuit voltage needs captures that start with a full cell.

    Otherwise the last part of the first capture with resistances is held back, but only from the fit of the resistances.
    The fit of the open-circuit voltage needs it, because no other data cover its range of SOC.
    """
    candidates = [each for each in captures if each.gives_resistances and _others_suffice(each, captures)]
    if candidates:
        chosen = min(candidates, key=lambda each: (each.gives_ocv, each.good["voltage_v"][0]))
        others = use_all([each for each in captures if each is not chosen])
        return replace(
            others, held_back=chosen, sentence=f"Validated on {chosen.capture.name}, with a fit that did not use it."
        )
    all_data = use_all(captures)
    return _hold_back_last_part(all_data) if all_data.resistance_captures else all_data


def _others_suffice(chosen: RecognizedCapture, captures: Sequence[RecognizedCapture]) -> bool:
    """Return True if the other captures determine the resistances at a similar temperature, and the OCV."""
    others = [each for each in captures if each is not chosen]
    has_neighbor = any(
        each.gives_resistances and not abs(each.temperature_c - chosen.temperature_c) >= MIN_SPAN_K for each in others
    )  # the negation includes NaN, so that an unknown temperature is similar to every temperature
    return has_neighbor and (any(each.gives_ocv for each in others) or not chosen.gives_ocv)


def _hold_back_last_part(all_data: Split) -> Split:
    """Return the split that holds back the last part of the first capture with resistances."""
    chosen, *others = all_data.resistance_captures
    samples = chosen.good
    throughput_as = np.cumsum(np.append(np.abs(step_charges_as(samples["time_s"], samples["current_a"])), 0.0))
    end = int(np.argmax(throughput_as >= FIT_FRACTION * throughput_as[-1]))
    first_part = chosen.with_capture(Columns(samples[:end], f"first part of {chosen.capture.name}"))
    return replace(
        all_data,
        resistance_captures=(first_part, *others),
        held_back=chosen,
        held_back_from_s=float(samples["time_s"][end] - samples["time_s"][0]),
        sentence=(
            f"Validated on the last {100.0 * (1.0 - FIT_FRACTION):.0f} % of the charge in {chosen.capture.name}, by resistances "
            "that were fitted without these data; the OCV was fitted to the whole capture."
        ),
    )


@dataclass(frozen=True)
class FittedModel:
    """Cell model fitted to captures.

    Attributes:
        cell: The cell model.
        ocv: Fit of the open-circuit voltage; None if no capture determines it, so that the given cell's OCV is used.
        identification: Fit of the resistances; None if the resistances of the most similar generic cell are used.
        reason: Reason why the resistances are generic; empty if they were identified.
    """

    cell: CellModel
    ocv: OcvCell | None
    identification: Identification | None
    reason: str

    def initial_soc(self, recognized: RecognizedCapture) -> float:
        """Return the SOC at the first sample of a capture, from the identification or else from the capture's first rest."""
        if recognized.start.origin is StartOrigin.GIVEN:
            return recognized.start.soc
        if self.identification is not None:
            for fit in self.identification.captures:
                if fit.name == recognized.capture.name:
                    return fit.initial_soc
        return soc_of_first_rest(clean_capture(recognized.capture.name, recognized.good, self.cell), self.cell)


@dataclass(frozen=True)
class ModelFitter:
    """Fitter of cell models, with the inputs that the fit without the data held back shares with the fit of all data.

    Attributes:
        initial_cell: Given cell with the capacity. It supplies what the captures do not determine.
        capacity: Capacity of the cell.
        curves: Open-circuit voltages over SOC that were measured otherwise.
        name: Name of the new cell.
    """

    initial_cell: CellModel
    capacity: CapacityEstimate
    curves: Sequence[ExternalCurve]
    name: str

    def fit(self, data: Split, progress: Progress) -> FittedModel:
        """Fit the open-circuit voltage, and then the resistances.

        Args:
            data: Captures of the fit.
            progress: Receives the finished fraction of the fit.

        Raises:
            UserError: A capture cannot be used, or neither OCV nor resistances are determined.
        """
        ocv = self._fit_ocv(data.ocv_captures)
        cell = self.initial_cell if ocv is None else ocv.cell
        if ocv is not None and not self.capacity.from_slow_discharge:  # otherwise the OCV's fit has set its std
            cell = with_capacity(cell, cell.cell.capacity_ah, self.capacity.relative_std)
        if not data.resistance_captures:
            return FittedModel(cell, ocv, None, "no capture has a current above 0.1 C")
        captures = [each.capture for each in data.resistance_captures]
        given_socs = {
            each.capture.name: each.start.soc
            for each in data.resistance_captures
            if each.start.origin is StartOrigin.GIVEN
        }
        try:
            identification = identify(captures, cell, initial_socs=given_socs, progress=progress)
        except UserError as error:
            if ocv is None:
                raise
            reason = str(error).splitlines()[0].partition(";")[0]  # the text after the semicolon is a remedy
            return FittedModel(cell, ocv, None, reason)
        return FittedModel(with_name(identification.cell, self.name), ocv, identification, "")

    def _fit_ocv(self, captures: Sequence[RecognizedCapture]) -> OcvCell | None:
        """Fit the open-circuit voltage; None if nothing determines it."""
        if not captures and not self.curves:
            return None
        return determine_ocv(
            [Recording(each.capture.name, each.capture.rows, each.start) for each in captures],
            self.curves,
            name=self.name,
            capacity_ah=None if self.capacity.from_slow_discharge else self.capacity.capacity_ah,
            series_count=1,
        )
