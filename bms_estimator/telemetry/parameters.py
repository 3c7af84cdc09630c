"""Topic ``parameters``.

A1..a21 and the elements, each with its error, its source, and the reason if it is not valid.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import (
    IdentifiedValue,
    current_offset,
    fitted_parameter,
    ocv_correction_with_std,
    present_elements,
    relative_capacity,
    relative_series_resistance,
)
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.kernels.kalman_filter.element_map import ELEMENT_NAMES
from bms_estimator.model.cell import CellModel
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.fuel_cell import FuelCellModel
from bms_estimator.model.payloads import OcvCurve, Parameter, ParameterReport
from bms_estimator.telemetry.fuel_cell_parameters import VALID_STD, fuel_cell_parameters
from bms_estimator.telemetry.ocv_formula import formula
from bms_estimator.telemetry.series_resistance import series_resistance_parameters
from bms_estimator.telemetry.state import finite

OCV_SOC = np.round(np.linspace(0.0, 1.0, 21), 2)
"""SOCs at which the OCV is published."""
CONFIGURED = "configured value: no data has identified it"
LEARNED = "learned by the observer's law, which knows no error of it"
VALID_FIT_STD = 0.5
"""Maximum relative std of a valid a1..a15: amplitudes and exponents show only where the SOC was swept."""
VALID_CAPACITY_STD = 0.02
VALID_OFFSET = 0.5
"""An offset is identified when its standard deviation is below this part of the first one."""
_FUNCTIONS = {
    "r_s_ohm": chen_mora.r_s,  # (2.9)
    "r_ts_ohm": chen_mora.r_ts,  # (2.5)
    "c_ts_farad": chen_mora.c_ts,  # (2.7)
    "r_tl_ohm": chen_mora.r_tl,  # (2.6)
    "c_tl_farad": chen_mora.c_tl,  # (2.8)
}


def make_parameters_payload(estimator: Estimator, now_s: float) -> ParameterReport:
    """Topic ``parameters``: a1..a15 as the observer holds them, a16..a21 of the cell file, elements at the present SOC.

    Where the cell file gives the OCV as a table, a16..a21 are (2.10) fitted to it.

    Args:
        estimator: Read only.
        now_s: Wall clock [s since 1970].
    """
    if isinstance(estimator.cell, FuelCellModel):
        return _of_fuel_cell(estimator, now_s)
    a, state = estimator.cell.a.copy(), estimator.state[0]
    if not state["started"]:
        return ParameterReport(
            publish_time=iso_utc(now_s),
            soc=None,
            a=_of_cell_file(estimator.cell, a),
            ocv=None,
            elements={},
            state_of_health={},
        )
    a[1:16] = state["a"][1:16]
    parameters, elements = _of_cell_file(estimator.cell, a), _elements_of(estimator, a)
    health: dict[str, Parameter] = {}
    learning, record = bool(estimator.settings_record["learning"]["enabled"][0]), estimator.record[0]
    led = _is_data_driven(estimator)
    for i in range(1, 16):
        held = parameters[f"a{i}"] = _of_source(parameters[f"a{i}"], led[i], learning)
        if estimator.identifying and not learning:
            parameters[f"a{i}"] = _parameter(held, fitted_parameter(record, i), now_s)
    for e, name in enumerate(ELEMENT_NAMES):
        elements[name] = _of_source(elements[name], led[3 * e + 1 : 3 * e + 4].any(), learning)
    if estimator.identifying:
        for name, one in present_elements(record).items():
            elements[name] = _identified(one, elements[name], VALID_STD, now_s)
        health = _state_of_health(estimator, now_s)
    if estimator.settings_record["series_resistance"][0]:
        found = series_resistance_parameters(estimator)
        elements["r_s_ohm"] = found.pop("r_s_ohm")
        parameters |= found
    return ParameterReport(
        publish_time=iso_utc(now_s),
        soc=finite(state["soc"]),
        a=parameters,
        ocv=_ocv(estimator) if estimator.identifying else None,
        elements=elements,
        state_of_health=health,
    )


def _of_fuel_cell(estimator: Estimator, now_s: float) -> ParameterReport:
    """No SOC, no a1..a21; learned values are among the elements."""
    elements = fuel_cell_parameters(estimator, now_s) if estimator.state[0]["started"] else {}
    return ParameterReport(publish_time=iso_utc(now_s), soc=None, a={}, ocv=None, elements=elements, state_of_health={})


def _of_cell_file(cell: CellModel, a: np.ndarray) -> dict[str, Parameter]:
    parameters = {f"a{i}": _configured(a[i], "") for i in range(1, 22)}
    fit = formula(cell)
    if fit is None:
        return parameters
    reason = f"(2.10) fitted to the table of the cell file, {1e3 * fit.rms_v:.1f} mV RMS off it"
    for i, (value, std) in enumerate(zip(fit.a, fit.std, strict=True), start=16):
        parameters[f"a{i}"] = Parameter(value=value, std=finite(std), valid=False, source="configured", reason=reason)
    return parameters


def _ocv(estimator: Estimator) -> OcvCurve:
    """Return the filter's OCV with its error: the cell file's plus the learned correction."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    p = settings["filter"]
    correction_v, std_v = ocv_correction_with_std(record, settings, OCV_SOC)
    given_v = _given_v(p["ocv_v"].tobytes(), p["ocv_slope_v"].tobytes())
    return OcvCurve(soc=OCV_SOC.tolist(), ocv_v=(given_v + correction_v).tolist(), std_v=std_v.tolist())


@lru_cache(maxsize=64)
def _given_v(ocv_v: bytes, ocv_slope_v: bytes) -> NDArray[np.float64]:
    """Return the cell file's OCV at ``OCV_SOC`` [V], from the filter's tables."""
    curve, slope = np.frombuffer(bytearray(ocv_v)), np.frombuffer(bytearray(ocv_slope_v))
    return np.array([chen_mora.ocv(soc, curve, slope) for soc in OCV_SOC])


def _elements_of(estimator: Estimator, a: np.ndarray) -> dict[str, Parameter]:
    """(2.5)-(2.10) at the present SOC; below delta1 (delta2) the capacitance is not positive and is left out."""
    state, ocv = estimator.state[0], estimator.settings[0]
    soc = float(state["soc"])
    limits = {"c_ts_farad": "delta_1", "c_tl_farad": "delta_2"}
    elements = {}
    for name, function in _FUNCTIONS.items():
        value, limit = function(soc, a), limits.get(name, "")
        why_not = f"SOC {soc:.4f} is not above {limit} = {state[limit]:.4f}" if limit else ""
        elements[name] = _configured(value if value > 0.0 else math.nan, why_not)
    elements["e_o_v"] = _configured(chen_mora.ocv(soc, ocv["ocv_v"], ocv["ocv_slope_v"]), "")
    return elements


def _state_of_health(estimator: Estimator, now_s: float) -> dict[str, Parameter]:
    """Capacity and R_s over those of the cell file."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    ratio, p = relative_series_resistance(record, settings), settings["filter"]
    capacity, offset_a = relative_capacity(record), current_offset(record)
    first_std_a = float(p["offset_c"] * p["capacity_as"]) / 3600.0
    return {
        "capacity": _bias(capacity, VALID_CAPACITY_STD, "identifier.capacity_std", now_s),
        "r_s": _identified(ratio, _configured(1.0, ""), VALID_STD, now_s),
        "current_offset_a": _bias(offset_a, VALID_OFFSET * first_std_a, "identifier.current_offset_std_a", now_s),
    }


def _bias(learned: IdentifiedValue, limit: float, setting: str, now_s: float) -> Parameter:
    """Bias of the sensor or the capacity, valid below ``limit`` [its unit]."""
    value, std = finite(learned.value), finite(learned.std)
    if std == 0.0:
        declared = f"{setting} is 0: taken as declared"
        return Parameter(value=value, std=None, valid=False, source="configured", reason=declared)
    valid = learned.std < limit
    reason = None if valid else f"known to {learned.std:.2g} so far, valid below {limit:.2g}"
    return Parameter(value=value, std=std, valid=valid, source="identified", updated=iso_utc(now_s), reason=reason)


def _is_data_driven(estimator: Estimator) -> np.ndarray:
    """Return which of a1..a15 data have moved from the configured values: by the adaptive law, else by the fit that (3.18) follows."""
    state, settings = estimator.state[0], estimator.settings_record[0]
    if settings["learning"]["enabled"]:
        return np.asarray(state["a"] != settings["learning"]["file"])
    return np.asarray(state["target"] != settings["observer"]["target"])


def _of_source(held: Parameter, led: np.bool_, learning: bool) -> Parameter:
    """Parameter of the observer; its source is the data where those have moved it."""
    if not led:
        return held
    return held.model_copy(update={"source": "identified"} | ({"reason": LEARNED} if learning else {}))


def _parameter(held: Parameter, fit: IdentifiedValue | None, now_s: float) -> Parameter:
    """a_i as the observer holds it, with the error that the fit has."""
    if fit is None or held.source == "configured":
        return held
    known = _identified(fit, held, VALID_FIT_STD, now_s)
    return known.model_copy(update={"value": held.value}) if known.valid else known


def _identified(learned: IdentifiedValue, held: Parameter, limit: float, now_s: float) -> Parameter:
    """Learned value if its error is small enough, otherwise the observer's value and the progress of learning."""
    if math.isinf(learned.age_s):
        return held
    if learned.relative_std < limit:
        updated = iso_utc(max(now_s - learned.age_s, 0.0))
        return Parameter(
            value=finite(learned.value), std=finite(learned.std), valid=True, source="identified", updated=updated
        )
    if held.value is None:
        return held
    why = f"identified to {learned.relative_std:.0%} so far, valid below {limit:.0%}"
    std = math.hypot(learned.std, learned.value - held.value)  # of the configured value, by the known error
    return held.model_copy(update={"std": finite(std), "reason": why})


def _configured(value: float, why_missing: str) -> Parameter:
    number = finite(value)
    return Parameter(
        value=number,
        std=None,
        valid=False,
        source="configured",
        reason=why_missing if number is None else CONFIGURED,
    )
