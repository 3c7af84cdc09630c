"""Payloads of the topics ``state``, ``info`` and ``forecast``, the text of a cut-off, and the pack's capacity."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.forecast.available_power import FORECAST, Forecast, unknown_values
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import Floats, ProbeBlock
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.pack_model import PackModel
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import PAYLOAD_VERSION
from bms_estimator.model.payloads.snapshot import ForecastReport, Info
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.publish_window import ChargeEnergy, WindowSummary
from bms_estimator.version import __version__

MIN_SHOWN_MEDIAN_S = 600.0
"""Minimum median time to the cut-off that is shown [s]. Below it only the band and the probability are shown, because a single
load peak may decide."""


CUTOFF_FIELDS = ("time_to_cutoff_s", "time_to_cutoff_p05_s", "time_to_cutoff_p95_s", "cutoff_within_5min")
"""Published fields that are the arguments of ``cutoff_text``."""


def cutoff_text(
    median_s: float | None, p05_s: float | None, p95_s: float | None, within_5min: float | None
) -> str | None:
    """Return the time to the cut-off with its 90 % band; None if it is unknown.

    For example ``1:52 h (1:20 to 2:31)``, or below ``MIN_SHOWN_MEDIAN_S`` ``3 to 9 min, 40 % within 5 min``.

    Args:
        median_s: Median of the time to the cut-off [s].
        p05_s: 5 % quantile of this time [s].
        p95_s: 95 % quantile of this time [s].
        within_5min: Probability of the cut-off within 5 min, 0..1.
    """
    if median_s is None or p05_s is None or p95_s is None:
        return None
    if median_s >= MIN_SHOWN_MEDIAN_S:
        return f"{clock_duration(median_s)} h ({clock_duration(p05_s)} to {clock_duration(p95_s)})"
    band = f"{p05_s / 60.0:.0f} to {p95_s / 60.0:.0f} min"
    return band if within_5min is None else f"{band}, {100.0 * within_5min:.0f} % within 5 min"


def clock_duration(duration_s: float) -> str:
    """Return hours and minutes, ``1:52``."""
    hours, minutes = divmod(math.floor(duration_s / 60.0 + 0.5), 60)
    return f"{hours}:{minutes:02d}"


UNKNOWN_SOC = "the SOC is not known yet: charge the pack to full once, or (not LFP) let it rest for ten minutes"
"""Reason for a missing value that needs a known SOC, with the remedy."""
ALWAYS_STABLE = "the thesis's model is valid at each SOC: delta_1 and delta_2 are not above 0"
"""Reason for a missing margin while the capacitances are positive at each SOC."""
NOT_IDENTIFIED = "delta_1 and delta_2 follow from a7..a12, which are not valid: see the topic parameters"
"""Reason for a missing margin while the capacitances over SOC are not known."""


def known_margin(trace: Any, soc_known: Any) -> Any:
    """Return the stability margin of rows of dtype TRACE, NaN without a margin or a known SOC.

    Args:
        trace: One row, or shape (n,).
        soc_known: True where the SOC is known, of the same shape.
    """
    return np.where(soc_known, trace["stability_margin"], np.nan)


def missing_margin_reason(row: np.void, *, soc_known: bool) -> str | None:
    """Return the reason why a battery has no stability margin; None if it has one, and for a fuel cell.

    Args:
        row: Estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):  # a fuel cell
        return None
    if math.isnan(row["stability_margin"]):
        return NOT_IDENTIFIED if max(row["delta_1"], row["delta_2"]) > 0.0 else ALWAYS_STABLE
    return None if soc_known else UNKNOWN_SOC


FORECAST_FIELDS = FORECAST.names or ()
"""Fields of ``Estimate`` that a forecast supplies."""
DURATIONS = tuple(name for name in FORECAST_FIELDS if name.startswith("time_to_"))
"""Fields that are durations, which decrease between two forecasts [s]."""
CURVES = ("soc_p05", "soc_p50", "soc_p95", "voltage_p05_v", "voltage_p50_v", "voltage_p95_v", "survival")
"""Fields of ``ForecastCurve`` and ``ForecastReport``."""


def no_forecast(reason: str) -> Forecast:
    """Return a forecast without values, for a pack without a forecaster."""
    return Forecast(math.nan, unknown_values(), reason, None)


def forecast_fields(forecast: Forecast, time_s: float) -> dict[str, Any]:
    """Return the fields of ``Estimate`` that a forecast supplies. Durations count from the published sample.

    Args:
        forecast: The last forecast.
        time_s: Time stamp of the published sample [s].
    """
    elapsed_s = max(time_s - forecast.time_s, 0.0)
    values = dict(zip(FORECAST_FIELDS, forecast.values[0].item(), strict=True))
    values |= {name: max(values[name] - elapsed_s, 0.0) for name in DURATIONS if math.isfinite(values[name])}
    known = {name: value if math.isfinite(value) else None for name, value in values.items()}
    return known | {"forecast_reason": forecast.reason}


def make_forecast_payload(forecast: Forecast, cutoff_v: float, window: WindowSummary, now_s: float) -> ForecastReport:
    """Return the payload of the topic ``forecast``.

    Args:
        forecast: The last forecast.
        cutoff_v: Voltage at which the load is switched off [V].
        window: Summary since the last publication.
        now_s: Wall clock [s since 1970].
    """
    curve = forecast.curve
    age_s = max(float(window.last["time_s"]) - forecast.time_s, 0.0)  # NaN before the first forecast
    return ForecastReport(
        time=iso_utc(max(window.arrival_s - age_s, 0.0) if math.isfinite(age_s) else window.arrival_s),
        publish_time=iso_utc(now_s),
        reason=forecast.reason,
        cutoff_v=cutoff_v,
        elapsed_s=_numbers(curve.elapsed_s) if curve else [],
        **{name: _numbers(getattr(curve, name)) if curve else [] for name in CURVES},
    )


def _numbers(values: Floats) -> list[float | None]:
    """Return values with five significant digits; None for NaN."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values.tolist()]


NO_CELL_FIELDS: Mapping[str, Any] = MappingProxyType(
    dict.fromkeys(
        (
            *("weakest_cell", "weakest_cell_soc", "weakest_cell_soc_std", "weakest_cell_capacity"),
            *("usable_capacity_to_weakest_ah", "cell_soc_spread", "cell_r_spread"),
        ),
        None,
    )
)
"""Fields of ``Estimate`` about single cells while there is no estimate of them."""
COMPUTED = {
    *("voltage_estimate_v", "voltage_v", "current_a", "temperature_c", "stability_margin", "stability_margin_std"),
    *("delta_configured", "converged", "lock"),
}
"""Columns of the trace whose field of ``Estimate`` is computed: means, a margin that needs a known SOC, and booleans from
integers."""
COPIED = tuple(name for name in TRACE.names or () if name in Estimate.model_fields and name not in COMPUTED)
"""Columns of the trace whose last value is copied to the field of ``Estimate`` with an equal name."""


def finite(value: float) -> float | None:
    """Return the value as a float, or None if it is NaN or infinite."""
    number = float(value)
    return number if math.isfinite(number) else None


def make_state_payload(
    window: WindowSummary,
    remaining_capacity_ah: float,
    forecast: Forecast,
    counters: Mapping[str, int],
    now_s: float,
    charge_energy: ChargeEnergy,
    capacity_ah: float | None,
    cell_fields: Mapping[str, Any] = MappingProxyType({}),
    device_soc: float | None = None,
) -> Estimate:
    """Return the payload of topic ``state``.

    Args:
        window: Summary since the last publication.
        remaining_capacity_ah: Charge down to SOC 0 [Ah]; NaN if unknown.
        forecast: The last forecast.
        counters: Counters of the source.
        now_s: Wall clock [s since 1970].
        charge_energy: Charge and energy at the terminals.
        capacity_ah: Rated capacity of the pack [Ah]; None for a fuel cell.
        cell_fields: Fields about single cells (``telemetry.cells.single_cell_fields``).
        device_soc: SOC that the device reports, 0..1; None: not reported.
    """
    # a tuple of plain numbers, because reading the fields of a numpy record one by one is slow
    values = zip(TRACE.names or (), window.last.item(), strict=True)
    last = {name: value if math.isfinite(value) else None for name, value in values}
    innovation_v, soc, margin = last["innovation_v"], last["soc"], finite(known_margin(window.last, window.soc_known))
    is_known = soc is not None and window.soc_known
    return Estimate(
        time=iso_utc(window.arrival_s),
        publish_time=iso_utc(now_s),
        board_time_s=last["time_s"],
        voltage_v=window.voltage_v,
        current_a=window.current_a,
        power_w=window.power_w,
        temperature_c=finite(window.temperature_c),
        **_probes(window.probes),
        **_cells(window.cells_v),
        **{name: last[name] for name in COPIED},
        voltage_estimate_v=None if innovation_v is None else window.voltage_v - innovation_v,
        soc_percent=None if soc is None else 100.0 * soc,
        soc_known=is_known,
        device_soc=device_soc,
        device_soc_difference=soc - device_soc if soc is not None and is_known and device_soc is not None else None,
        stability_margin=margin,
        stability_margin_std=None if margin is None else last["stability_margin_std"],
        stability_margin_reason=missing_margin_reason(window.last, soc_known=window.soc_known),
        remaining_capacity_ah=finite(remaining_capacity_ah),
        **forecast_fields(forecast, float(window.last["time_s"])),
        **{**NO_CELL_FIELDS, **cell_fields},
        **charge_energy._asdict(),
        equivalent_cycles=charge_energy.charge_out_ah / capacity_ah if capacity_ah else None,
        delta_configured=bool(last["delta_configured"]),
        adaptive_gain_k=last["k"],
        converged=bool(last["converged"]),
        lock=bool(last["lock"]),
        frames_received=counters.get("frames_received", 0),
        frames_lost=counters.get("frames_lost", 0),
        crc_errors=counters.get("crc_errors", 0),
        sample_rate_hz=finite(window.sample_rate_hz),
    )


def _cells(cells_v: Floats) -> dict[str, Any]:
    """Return the fields of single cells. ``cells_v`` has shape (m,) [V], NaN for an unknown voltage."""
    if not (cells_v.size and np.isfinite(cells_v).any()):
        return dict.fromkeys(("cell_lowest_v", "cell_highest_v", "cell_lowest", "cell_highest", "cells_v"))
    lowest, highest = int(np.nanargmin(cells_v)), int(np.nanargmax(cells_v))
    return {
        "cell_lowest_v": float(cells_v[lowest]),
        "cell_highest_v": float(cells_v[highest]),
        "cell_lowest": lowest + 1,
        "cell_highest": highest + 1,
        "cells_v": [finite(volts) for volts in cells_v],
    }


def _probes(probes: ProbeBlock) -> dict[str, Any]:
    """Return the fields about temperature probes; None with fewer than two probes."""
    if probes.size < 2:
        return {"temperatures_c": None, "faulty_probes": None}
    return {
        "temperatures_c": [finite(reading_c) for reading_c in probes["temperature_c"]],
        "faulty_probes": (np.flatnonzero(probes["faulty"]) + 1).tolist(),
    }


def make_info_payload(
    settings: Settings, pack: PackModel, board: Mapping[str, str], started_s: float, *, temperature_sensor: bool
) -> Info:
    """Return the payload of topic ``info``.

    Args:
        settings: The pack's settings.
        pack: Model of the whole pack.
        board: Properties that the board reported.
        started_s: Wall clock at start [s since 1970].
        temperature_sensor: True if the cell temperature is measured.
    """
    learns = settings.observer.law == "learning" or pack.always_learns
    return Info(
        device=settings.pack.name,
        version=__version__,
        payload_version=PAYLOAD_VERSION,
        started=iso_utc(started_s),
        cell=pack.cell.name,
        capacity_ah=pack.capacity_ah,
        series_count=pack.cell.series_count,
        nominal_voltage_v=pack.cell.nominal_voltage_v,
        max_discharge_a=settings.pack.max_discharge_a,
        max_charge_a=settings.pack.max_charge_a,
        observer="learning" if learns else f"{settings.observer.law}, {settings.observer.nussbaum}",
        temperature_sensor=temperature_sensor,
        publish_rate_hz=settings.publish.rate_hz,
        board=dict(board),
    )


def remaining_capacity_ah(estimator: Estimator) -> float:
    """Return the charge down to SOC 0 [Ah]; NaN before the first sample.

    Args:
        estimator: Estimator; read only.
    """
    state = estimator.state[0]
    if not state["started"] or math.isnan(state["soc"]):
        return math.nan
    return float(state["soc"]) * full_capacity_ah(estimator)


def full_capacity_ah(estimator: Estimator) -> float:
    """Return the capacity [Ah] that the identifier has learned, after a sample; without an identifier, the declared capacity."""
    ratio = relative_capacity(estimator.record[0]).value if estimator.has_filter else 1.0
    return ratio * float(estimator.settings["capacity_as"][0]) / 3600.0
