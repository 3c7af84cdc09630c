"""Payload of the topic ``info``."""

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


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
    observer: str = Field(description="adaptation law, and N(k) for a law of the thesis")
    temperature_sensor: bool = Field(
        description="true: a cell temperature was received; without one 25 C is assumed and the resistances are less certain"
    )
    publish_rate_hz: float
    board: dict[str, str] = Field(description="properties reported by the board; empty before")
