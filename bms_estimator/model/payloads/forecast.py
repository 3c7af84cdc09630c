"""Payload of the topic ``forecast``."""

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


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
