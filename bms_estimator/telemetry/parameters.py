"""Payload of the topic ``parameters``: a1..a21 and the circuit elements.

Each value has its std, its source, and the reason if the value is not valid. a16..a21 are fitted to the OCV table of a cell
file. Numbers in parentheses are equations of the thesis.
"""

import math
from collections.abc import Mapping
from functools import cache, lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import Estimator
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
from bms_estimator.kernels.identifier import VALID_FIT_STD, VALID_STD
from bms_estimator.kernels.kalman_filter.element_map import ELEMENT_NAMES
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.monotone_cubic import MonotoneCubic
from bms_estimator.model.payloads.snapshot import OcvCurve, Parameter, ParameterReport
from bms_estimator.telemetry.fuel_cell_parameters import (
    fuel_cell_parameters,
    series_resistance_parameters,
    settling_reason,
)
from bms_estimator.telemetry.state import finite

FIT_POINTS = 101
"""Number of evenly spaced SOCs at which (2.10) is fitted."""


class OcvFormulaFit(NamedTuple):
    """Fit of the polynomial and exponential (2.10) to an OCV table.

    Attributes:
        a: a16..a21.
        std: Standard errors; NaN for a parameter at its bound.
        rms_v: Deviation of the formula from the table, RMS over SOC [V].
    """

    a: tuple[float, ...]
    std: tuple[float, ...]
    rms_v: float


def fit_ocv_formula(cell: CellModel) -> OcvFormulaFit | None:
    """Fit (2.10) to a cell's OCV table; None if the cell file gives (2.10) itself."""
    return _fit_table(cell.ocv) if isinstance(cell.ocv, TableOcv) else None


@cache
def _fit_table(ocv: TableOcv) -> OcvFormulaFit:
    from bms_estimator.calibration.ocv.chen_mora_fit import Points, fit_chen_mora, rms_v  # noqa: PLC0415

    soc = np.linspace(0.0, 1.0, FIT_POINTS)
    fit = fit_chen_mora(Points(soc, MonotoneCubic(ocv.soc, ocv.ocv_v)(soc), np.ones(FIT_POINTS)))
    return OcvFormulaFit(tuple(map(float, fit.a)), tuple(map(float, fit.std)), rms_v(fit.residual_v))


OCV_SOC = np.round(np.linspace(0.0, 1.0, 21), 2)
"""SOCs at which the OCV is published."""
CONFIGURED_REASON = "from the cell file: no data has identified it"
"""Reason why a value of the cell file is not valid."""
MOVED_REASON = "moved by the adaptive law of the thesis, which does not identify it"
"""Reason why a value that a law of the thesis has changed is not valid."""
MOVED_RATIO = 1e-6
"""Relative difference from the cell file above which a law of the thesis counts as having changed a value. Near its limit (3.18)
changes a value by less."""
LEARNED_REASON = "learned by the adaptive law, which gives no std"
"""Reason why a value of the learning law is not valid."""
CAPACITANCE_PARAMETERS = range(7, 13)
"""a7..a12, the parameters of C_ts and C_tl, (2.7) and (2.8)."""
VALID_CAPACITY_STD = 0.02
"""Maximum std of a valid capacity, relative to the capacity of the cell file."""
VALID_OFFSET_FRACTION = 0.5
"""Maximum std of a valid current offset, as a fraction of its std at the start."""
_AMPLITUDE_UNITS = {1: "ohm", 4: "ohm", 7: "F", 10: "F", 13: "ohm"}
"""Unit of amplitude a_i and offset a_(i+2) of an element, (2.5)-(2.9), by i."""
UNITS: Mapping[str, str] = MappingProxyType(
    {f"a{i + j}": "1" if j == 1 else unit for i, unit in _AMPLITUDE_UNITS.items() for j in range(3)}
    | {"a16": "V", "a17": "1", "a18": "V", "a19": "V", "a20": "V", "a21": "V"}
)
"""Unit of a1..a21; the exponents are per unit of SOC, a16..a21 are those of (2.10)."""
_ELEMENT_FUNCTIONS = {
    "r_s_ohm": chen_mora.r_s,  # (2.9)
    "r_ts_ohm": chen_mora.r_ts,  # (2.5)
    "c_ts_farad": chen_mora.c_ts,  # (2.7)
    "r_tl_ohm": chen_mora.r_tl,  # (2.6)
    "c_tl_farad": chen_mora.c_tl,  # (2.8)
}
"""Functions of SOC and a1..a15, by element."""


def make_parameters_payload(estimator: Estimator, now_s: float) -> ParameterReport:
    """Return the payload: a1..a15 of the observer, a16..a21 of the cell file, and the elements at the present SOC.

    If the cell file gives the OCV as a table, a16..a21 are a fit of (2.10) to the table.

    Args:
        estimator: Read only.
        now_s: Wall clock [s since 1970].
    """
    return estimator.cell.by_kind(
        lambda cell: _battery_report(estimator, cell, now_s), lambda _: _fuel_cell_report(estimator, now_s)
    )


def _battery_report(estimator: Estimator, cell: CellModel, now_s: float) -> ParameterReport:
    """Return the payload of a battery."""
    a, state = cell.a.copy(), estimator.state[0]
    if not state["started"]:
        return ParameterReport(
            publish_time=iso_utc(now_s),
            soc=None,
            a=_with_units(_cell_file_parameters(cell, a)),
            ocv=None,
            elements={},
            state_of_health={},
        )
    a[1:16] = state["a"][1:16]
    parameters, elements = _cell_file_parameters(cell, a), _elements_of(estimator, a)
    health: dict[str, Parameter] = {}
    learning, record = bool(estimator.settings_record["learning"]["enabled"][0]), estimator.record[0]
    from_data = _is_data_driven(estimator)
    unlearned_reason = _unlearned_reason(estimator)
    for i in range(1, 16):
        parameter = _mark_source(_with_reason(parameters[f"a{i}"], unlearned_reason[i]), from_data[i], learning)
        if estimator.has_filter and not learning:
            parameter = _with_fit_std(parameter, fitted_parameter(record, i), now_s)
            if i in CAPACITANCE_PARAMETERS:
                parameter = _with_tau_validity(parameter, estimator)
        parameters[f"a{i}"] = parameter
    for e, name in enumerate(ELEMENT_NAMES):  # each element has three parameters, from a1 on
        indices = slice(3 * e + 1, 3 * e + 4)
        reason = next((each for each in unlearned_reason[indices] if each != CONFIGURED_REASON), CONFIGURED_REASON)
        elements[name] = _mark_source(_with_reason(elements[name], reason), from_data[indices].any(), learning)
    if estimator.has_filter:
        for name, identified in present_elements(record).items():
            elements[name] = _select_parameter(identified, elements[name], VALID_STD, now_s)
        health = _state_of_health(estimator, now_s)
    if estimator.settings_record["series_resistance"][0]:  # R_s comes from (4.2)
        fitted = series_resistance_parameters(estimator)
        elements["r_s_ohm"] = fitted.pop("r_s_ohm")
        parameters |= fitted
    return ParameterReport(
        publish_time=iso_utc(now_s),
        soc=finite(state["soc"]),
        a=_with_units(parameters),
        ocv=_ocv(estimator) if estimator.has_filter else None,
        elements=elements,
        state_of_health=health,
    )


def _fuel_cell_report(estimator: Estimator, now_s: float) -> ParameterReport:
    """Return the payload of a fuel cell: no SOC, no a1..a21, and the learned values as elements."""
    elements = fuel_cell_parameters(estimator, now_s) if estimator.state[0]["started"] else {}
    return ParameterReport(publish_time=iso_utc(now_s), soc=None, a={}, ocv=None, elements=elements, state_of_health={})


def _cell_file_parameters(cell: CellModel, a: np.ndarray) -> dict[str, Parameter]:
    """Return a1..a21 as configured values; a16..a21 are fitted if the cell file has an OCV table."""
    parameters = {f"a{i}": _configured_parameter(a[i], "") for i in range(1, 22)}
    fit = fit_ocv_formula(cell)
    if fit is None:
        return parameters
    reason = f"(2.10) fitted to the table of the cell file, {1e3 * fit.rms_v:.1f} mV RMS off it"
    for i, (value, std) in enumerate(zip(fit.a, fit.std, strict=True), start=16):
        parameters[f"a{i}"] = Parameter(value=value, std=finite(std), valid=False, source="configured", reason=reason)
    return parameters


def _with_units(parameters: dict[str, Parameter]) -> dict[str, Parameter]:
    return {name: parameter.model_copy(update={"unit": UNITS[name]}) for name, parameter in parameters.items()}


def _ocv(estimator: Estimator) -> OcvCurve:
    """Return the filter's OCV with its std: the OCV of cell file or slow fit plus the filter's correction."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    p = settings["filter"]
    correction_v, std_v = ocv_correction_with_std(record, settings, OCV_SOC)
    curve_v = _filter_ocv(p["ocv_v"].tobytes(), p["ocv_slope_v"].tobytes())
    return OcvCurve(soc=OCV_SOC.tolist(), ocv_v=(curve_v + correction_v).tolist(), std_v=std_v.tolist())


@lru_cache(maxsize=64)
def _filter_ocv(ocv_v: bytes, ocv_slope_v: bytes) -> NDArray[np.float64]:
    """Return the OCV at ``OCV_SOC`` [V] from the tables of the filter."""
    curve, slope = np.frombuffer(bytearray(ocv_v)), np.frombuffer(bytearray(ocv_slope_v))
    return np.array([chen_mora.ocv(soc, curve, slope) for soc in OCV_SOC])


def _elements_of(estimator: Estimator, a: np.ndarray) -> dict[str, Parameter]:
    """Return the elements of (2.5)-(2.10) at the present SOC.

    A capacitance that is not positive is null. C_ts is not positive up to the SOC delta1, C_tl up to delta2.
    """
    state, settings = estimator.state[0], estimator.settings[0]
    soc = float(state["soc"])
    limits = {"c_ts_farad": "delta_1", "c_tl_farad": "delta_2"}
    elements = {}
    for name, function in _ELEMENT_FUNCTIONS.items():
        value, limit = function(soc, a), limits.get(name, "")
        why_missing = f"SOC {soc:.4f} is not above {limit} = {state[limit]:.4f}" if limit else ""
        elements[name] = _configured_parameter(value if value > 0.0 else math.nan, why_missing)
    elements["e_o_v"] = _configured_parameter(chen_mora.ocv(soc, settings["ocv_v"], settings["ocv_slope_v"]), "")
    return elements


def _state_of_health(estimator: Estimator, now_s: float) -> dict[str, Parameter]:
    """Return capacity and R_s relative to the cell file, and the offset of the current sensor."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    ratio, p = relative_series_resistance(record, settings, estimator.cell_file_settings), settings["filter"]
    capacity, offset_a = relative_capacity(record), current_offset(record)
    initial_std_a = float(p["offset_c"] * p["capacity_as"]) / 3600.0
    return {
        "capacity": _bias_parameter(capacity, VALID_CAPACITY_STD, "identifier.capacity_std", now_s),
        "r_s": _select_parameter(ratio, _configured_parameter(1.0, ""), VALID_STD, now_s),
        "current_offset_a": _bias_parameter(
            offset_a, VALID_OFFSET_FRACTION * initial_std_a, "identifier.current_offset_std_a", now_s
        ),
    }


def _bias_parameter(learned: IdentifiedValue, limit: float, setting: str, now_s: float) -> Parameter:
    """Return a bias of the sensor or of the capacity, valid if its std is below ``limit``.

    ``setting`` is the key of its initial std in the settings.
    """
    value, std = finite(learned.value), finite(learned.std)
    if std == 0.0:
        declared = f"{setting} is 0: the configured value counts as exact"
        return Parameter(value=value, std=None, valid=False, source="configured", reason=declared)
    valid = learned.std < limit
    reason = None if valid else f"std {learned.std:.2g} so far, valid below {limit:.2g}"
    return Parameter(value=value, std=std, valid=valid, source="identified", updated=iso_utc(now_s), reason=reason)


def _is_data_driven(estimator: Estimator) -> np.ndarray:
    """Return a mask of the parameters that data have changed, a1..a15 at index 1..15.

    The learning law changes them itself. Otherwise the identifier sets its fit as the targets of (3.18).
    """
    state, settings = estimator.state[0], estimator.settings_record[0]
    if settings["learning"]["enabled"]:
        return np.asarray(state["a"] != settings["learning"]["file"])
    return np.asarray(state["target"] != settings["observer"]["target"])


def _unlearned_reason(estimator: Estimator) -> list[str]:
    """Return the reason why a1..a15, at index 1..15, are not valid without data."""
    record, settings = estimator.record[0], estimator.settings_record[0]
    if settings["learning"]["enabled"]:
        return [settling_reason(float(record["learning"]["settle_s"])) or CONFIGURED_REASON] * 16
    file_a = settings["configured"]
    moved = np.abs(record["observer"]["a"] - file_a) > MOVED_RATIO * np.abs(file_a)
    return [MOVED_REASON if each else CONFIGURED_REASON for each in moved]


def _with_reason(parameter: Parameter, reason: str) -> Parameter:
    """Return a value of the cell file with its reason. A missing value keeps the reason why it is missing."""
    return parameter if parameter.value is None else parameter.model_copy(update={"reason": reason})


def _mark_source(observer_value: Parameter, from_data: np.bool_, learning: bool) -> Parameter:
    """Return a parameter of the observer, marked as identified if data have changed it."""
    if not from_data:
        return observer_value
    return observer_value.model_copy(update={"source": "identified"} | ({"reason": LEARNED_REASON} if learning else {}))


def _with_fit_std(observer_value: Parameter, fit: IdentifiedValue | None, now_s: float) -> Parameter:
    """Return the observer's value of a parameter with the std of the fit."""
    if fit is None or observer_value.source == "configured":
        return observer_value
    value = observer_value.value
    if value is not None:  # the observer's value differs from the fit if a bound limits the fit
        fit = fit._replace(value=value, std=math.hypot(fit.std, fit.value - value))
    return _select_parameter(fit, observer_value, VALID_FIT_STD, now_s)


def _with_tau_validity(parameter: Parameter, estimator: Estimator) -> Parameter:
    """Return a parameter of a capacitance, not valid unless data have determined the time constants.

    A capacitance is a time constant divided by a resistance. The filter learns the resistances; the time constants of both RC
    pairs follow from the ratios of the RC ladder, which only a fit to data determines.
    """
    r_std = float(estimator.settings_record[0]["filter"]["r_std"])
    if not parameter.valid or r_std < VALID_STD:
        return parameter
    reason = f"the resistances of the RC ladder, which give the time constants, have a std of {r_std:.0%}; valid below {VALID_STD:.0%}"
    return parameter.model_copy(update={"valid": False, "reason": reason})


def _select_parameter(learned: IdentifiedValue, observer_value: Parameter, limit: float, now_s: float) -> Parameter:
    """Return the learned value if its relative std is below ``limit``.

    Otherwise return the observer's value, with the progress of learning as its reason.
    """
    if math.isinf(learned.age_s):
        return observer_value
    if learned.relative_std < limit:
        updated = iso_utc(max(now_s - learned.age_s, 0.0))
        return Parameter(
            value=finite(learned.value), std=finite(learned.std), valid=True, source="identified", updated=updated
        )
    if observer_value.value is None:
        return observer_value
    reason = f"identified to {learned.relative_std:.0%} so far, valid below {limit:.0%}"
    # the observer's value deviates from the true one by the std of the learned value and the distance to it
    std = math.hypot(learned.std, learned.value - observer_value.value)
    return observer_value.model_copy(update={"std": finite(std), "reason": reason})


def _configured_parameter(value: float, why_missing: str) -> Parameter:
    """Return a configured value; ``why_missing`` is the reason if it is not finite."""
    number = finite(value)
    return Parameter(
        value=number,
        std=None,
        valid=False,
        source="configured",
        reason=why_missing if number is None else CONFIGURED_REASON,
    )
