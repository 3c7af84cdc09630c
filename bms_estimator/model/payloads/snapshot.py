"""Payloads of one publication, for the topics ``forecast``, ``cells``, ``info``, ``alarm/<name>`` and ``parameters``.

The modules ``estimate`` and ``health`` define the payloads of the topics ``state`` and ``health``.
"""

from typing import Literal, NamedTuple

from pydantic import Field

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import Health, Payload


class Parameter(Payload):
    """One parameter with its error and validity."""

    value: float | None = Field(description="value in the unit of its name, or in ``unit``")
    std: float | None = Field(description="standard deviation in the same unit; null if unknown")
    valid: bool = Field(
        description="true: data have determined the value, with a std below a limit, which ``reason`` states if it is exceeded; "
        "a7..a12 also need time constants from data. A configured value is never valid"
    )
    source: Literal["configured", "identified"]
    updated: str | None = Field(default=None, description="time of the last informative data, ISO 8601, UTC")
    reason: str | None = Field(default=None, description="reason why the value is not valid, with numbers")
    unit: str | None = Field(
        default=None, description="unit of a1..a21; null: the name ends with the unit, or is a ratio"
    )


class OcvCurve(Payload):
    """Open-circuit voltage at 25 C over SOC, as presently used."""

    soc: list[float] = Field(description="SOC 0, 0.05 ... 1")
    ocv_v: list[float] = Field(
        description="open-circuit voltage of the pack [V]: that of the cell file with the learned correction"
    )
    std_v: list[float] = Field(description="standard deviation of ocv_v [V]")


class ParameterReport(Payload):
    """Topic ``parameters``: a1..a21 and the elements at the present SOC."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    soc: float | None = Field(description="SOC to which the elements belong, 0..1")
    a: dict[str, Parameter] = Field(description="a1..a21 of (2.5)-(2.10); empty for a fuel cell")
    ocv: OcvCurve | None = Field(
        description="open-circuit voltage; null before the first sample and without the identifier"
    )
    elements: dict[str, Parameter] = Field(
        description="r_s_ohm, r_ts_ohm, c_ts_farad, r_tl_ohm, c_tl_farad, e_o_v; for a fuel cell the values of its file"
    )
    state_of_health: dict[str, Parameter] = Field(
        description="capacity and r_s relative to the cell file (1: as new), r_s at the same SOC and temperature; "
        "current_offset_a: offset of the current sensor [A]"
    )


class Alarm(Payload):
    """Topic ``alarm/<name>``, retained: one alarm of a pack, raised or not."""

    name: str = Field(description="name in the topic and in [alarms]")
    severity: Literal["warning", "critical"]
    active: bool = Field(
        description="true: raised and not yet cleared; a latching alarm remains active until acknowledged"
    )
    latched: bool = Field(description="true: the cause is gone, and the alarm waits for an acknowledgment")
    since: str | None = Field(description="time at which it was raised, ISO 8601, UTC; null unless active")
    value: float | None = Field(description="measured value when it was raised, in unit; null without a number")
    limit: float | None = Field(description="limit, in unit; null without a number")
    unit: str | None = Field(description="unit of value and limit")
    text: str = Field(description="description and remedy; empty unless active")
    watched: bool = Field(
        default=True,
        description="false: a required quantity was measured before and is missing, so the alarm cannot be raised",
    )
    unwatched_reason: str | None = Field(default=None, description="reason why it is not watched; null while it is")
    unknown_reason: str | None = Field(
        default=None,
        description="reason why its value is not known, for example because the SOC is not, so that it is neither raised nor "
        "cleared; null while it is known",
    )


class Info(Payload):
    """Topic ``info``, retained: identity of the pack and the service."""

    device: str
    version: str = Field(description="version of bms_estimator")
    payload_version: int = Field(
        description="version of the payloads; increases when a field disappears or changes its type, unit or meaning"
    )
    started: str = Field(description="start of the service, ISO 8601, UTC")
    cell: str
    capacity_ah: float | None = Field(description="rated capacity of the pack [Ah]; null for a fuel cell")
    series_count: int
    nominal_voltage_v: float
    max_discharge_a: float | None = Field(
        description="pack.max_discharge_a [A]; null: not configured, so that the available power assumes a limit"
    )
    max_charge_a: float | None = Field(
        description="pack.max_charge_a [A]; null: not configured, so that the available power assumes a limit"
    )
    observer: str = Field(description="adaptation law, and N(k) for a law of the thesis")
    temperature_sensor: bool = Field(
        description="true: a cell temperature was received; without one 25 C is assumed and the resistances are less certain"
    )
    publish_rate_hz: float
    board: dict[str, str] = Field(description="properties reported by the board; empty before the first report")


CellFaultName = Literal["internal short", "contact", "sense wire", "wrong reading", "stuck reading"]
"""Fault of a cell, or of the reading of its voltage."""


class CellReport(Payload):
    """One cell in series."""

    number: int = Field(description="number, from 1")
    soc: float = Field(description="state of charge, 0..1")
    soc_std: float = Field(description="standard deviation of soc")
    soc_deviation: float = Field(description="SOC less the mean SOC of the cells")
    soc_deviation_std: float = Field(description="standard deviation of soc_deviation")
    resistance_ratio: float = Field(description="resistance relative to the median of the cells")
    resistance_ratio_std: float = Field(description="standard deviation of resistance_ratio")
    capacity_ratio: float = Field(description="capacity relative to the median of the cells")
    self_discharge_a: float = Field(description="self-discharge current above the median of the cells [A]")
    self_discharge_std_a: float = Field(description="standard deviation of self_discharge_a [A]")
    fault: CellFaultName | None = Field(
        description="internal short: a fault of the cell; contact, sense wire, wrong reading, stuck reading: faults of the "
        "measurement of its voltage; null: none"
    )


class CellsReport(Payload):
    """Topic ``cells``, retained: comparison of the cells in series of a pack with cell voltages."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    weakest: int = Field(description="number of the cell with the lowest SOC, from 1")
    cells: list[CellReport] = Field(description="all cells, from number 1 on")


class ForecastReport(Payload):
    """Topic ``forecast``: course of SOC and voltage until the cut-off. Each list has one value for each ``elapsed_s``."""

    time: str = Field(description="arrival time of the sample from which the forecast begins, ISO 8601, UTC")
    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    reason: str | None = Field(description="reason why the lists are empty; null if there is a forecast")
    cutoff_v: float = Field(description="voltage at which the load is switched off [V]")
    elapsed_s: list[float | None] = Field(description="time from ``time`` [s], increasing")
    soc_p05: list[float | None] = Field(description="5 % quantile of the SOC, 0..1")
    soc_p50: list[float | None] = Field(description="median of the SOC, 0..1")
    soc_p95: list[float | None] = Field(description="95 % quantile of the SOC, 0..1")
    voltage_p05_v: list[float | None] = Field(description="5 % quantile of the terminal voltage [V]")
    voltage_p50_v: list[float | None] = Field(description="median of the terminal voltage [V]")
    voltage_p95_v: list[float | None] = Field(description="95 % quantile of the terminal voltage [V]")
    survival: list[float | None] = Field(description="probability that the load is still on at this time, 0..1")


class Snapshot(NamedTuple):
    """Payloads of one publication."""

    estimate: Estimate | None
    """Estimate of the window; None without a sample."""
    parameters: ParameterReport
    health: Health
    info: Info
    alarms: tuple[Alarm, ...] = ()
    """All alarms, raised or not."""
    forecast: ForecastReport | None = None
    """Curves of the last forecast; None before the first sample and without a forecaster."""
    cells: CellsReport | None = None
    """Comparison of the cells, made once a minute; None without cell voltages."""
