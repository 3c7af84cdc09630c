"""Published values from the estimator's state: pure functions."""

import math
from collections.abc import Mapping

import numpy as np

from bms_estimator import __version__
from bms_estimator.estimator import Estimator
from bms_estimator.kernels import cell as chen_mora
from bms_estimator.model.cell import CellModel
from bms_estimator.model.estimate import Estimate, Info, Parameter, ParameterReport
from bms_estimator.model.settings import Settings
from bms_estimator.service.clock import iso_utc
from bms_estimator.service.window import WindowSummary

CONFIGURED = "configured value: no data has identified it"


def finite(value: float) -> float | None:
    """The value as a float, or None where it is NaN or infinite."""
    number = float(value)
    return number if math.isfinite(number) else None


def estimate_report(window: WindowSummary, counters: Mapping[str, int], now_s: float) -> Estimate:
    """Topic ``state``.

    Args:
        window: What came since the last publication.
        counters: The source's.
        now_s: Wall clock [s since 1970].
    """
    last = window.last
    soc = finite(last["soc"])
    return Estimate(
        time=iso_utc(window.arrival_s),
        publish_time=iso_utc(now_s),
        board_time_s=float(last["time_s"]),
        voltage_v=window.voltage_v,
        current_a=window.current_a,
        power_w=window.power_w,
        temperature_c=finite(window.temperature_c),
        soc=soc,
        soc_percent=None if soc is None else 100.0 * soc,
        voltage_estimate_v=finite(last["voltage_estimate_v"]),
        innovation_v=finite(last["innovation_v"]),
        delta_1=finite(last["delta_1"]),
        delta_2=finite(last["delta_2"]),
        stability_margin=finite(last["stability_margin"]),
        adaptive_gain_k=finite(last["k"]),
        nussbaum_gain=finite(last["nussbaum_gain"]),
        converged=bool(last["converged"]),
        lock=bool(last["lock"]),
        frames_received=counters.get("frames_received", 0),
        frames_lost=counters.get("frames_lost", 0),
        crc_errors=counters.get("crc_errors", 0),
        sample_rate_hz=finite(window.sample_rate_hz),
    )


def parameter_report(estimator: Estimator, now_s: float) -> ParameterReport:
    """Topic ``parameters``: a1..a15 as the observer holds them, a16..a21 of the cell file, elements at the present SOC.

    Args:
        estimator: Read only.
        now_s: Wall clock [s since 1970].
    """
    a = estimator.cell.a.copy()
    state = estimator.state[0]
    soc = None
    if state["started"]:
        a[1:16] = state["a"][1:16]
        soc = finite(state["soc"])
    return ParameterReport(
        publish_time=iso_utc(now_s),
        soc=soc,
        a={f"a{i}": _configured(a[i], "the OCV is a table: (2.10) does not apply") for i in range(1, 22)},
        elements={} if soc is None else _elements(estimator, soc, a),
    )


def _elements(estimator: Estimator, soc: float, a: np.ndarray) -> dict[str, Parameter]:
    """(2.5)-(2.10) at ``soc``; below delta1 (delta2) the capacitance is not positive and is left out."""
    ocv = estimator.settings[0]
    values = {
        "r_s_ohm": chen_mora.r_s(soc, a),  # (2.9)
        "r_ts_ohm": chen_mora.r_ts(soc, a),  # (2.5)
        "c_ts_farad": chen_mora.c_ts(soc, a),  # (2.7)
        "r_tl_ohm": chen_mora.r_tl(soc, a),  # (2.6)
        "c_tl_farad": chen_mora.c_tl(soc, a),  # (2.8)
        "e_o_v": chen_mora.ocv(soc, ocv["ocv_v"], ocv["ocv_slope_v"]),  # (2.10) or table
    }
    state = estimator.state[0]
    limits = {"c_ts_farad": ("delta_1", state["delta_1"]), "c_tl_farad": ("delta_2", state["delta_2"])}
    elements = {}
    for name, value in values.items():
        limit, soc_min = limits.get(name, ("", 0.0))
        why_not = f"SOC {soc:.4f} is not above {limit} = {soc_min:.4f}"
        elements[name] = _configured(value if value > 0.0 else math.nan, why_not)
    return elements


def _configured(value: float, why_missing: str) -> Parameter:
    number = finite(value)
    return Parameter(
        value=number,
        std=None,
        valid=False,
        source="configured",
        reason=why_missing if number is None else CONFIGURED,
    )


def info_report(settings: Settings, cell: CellModel, board: Mapping[str, str], started_s: float) -> Info:
    """Topic ``info``.

    Args:
        settings: The pack's settings.
        cell: The pack as one object.
        board: What the board said of itself.
        started_s: Wall clock at start [s since 1970].
    """
    return Info(
        device=settings.pack.name,
        version=__version__,
        started=iso_utc(started_s),
        cell=cell.cell.name,
        capacity_ah=cell.cell.capacity_ah,
        series_count=cell.cell.series_count,
        nominal_voltage_v=cell.cell.nominal_voltage_v,
        observer=f"{settings.observer.law}, {settings.observer.nussbaum}",
        publish_rate_hz=publish_rate_hz(settings),
        board=dict(board),
    )


def publish_rate_hz(settings: Settings) -> float:
    """How often snapshots are made [Hz]; 1 Hz where there is no broker."""
    return settings.mqtt.publish_rate_hz if settings.mqtt else 1.0
