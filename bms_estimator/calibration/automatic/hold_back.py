"""Choice of the data that are held back from a fit, so that the model can be validated on them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bms_estimator.calibration.automatic.recognition import RecognizedCapture
from bms_estimator.calibration.elements.capture_run import MIN_SPAN_K
from bms_estimator.kernels.cell_model.rc_ladder import REFERENCE_C
from bms_estimator.model.charge_count import step_charges_as
from bms_estimator.model.columns import Columns

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
