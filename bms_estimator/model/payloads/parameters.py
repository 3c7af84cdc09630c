"""Payload of the topic ``parameters``."""

from typing import Literal

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


class Parameter(Payload):
    """One parameter with its error and validity."""

    value: float | None = Field(description="value in the unit of its name, or in ``unit``")
    std: float | None = Field(description="standard deviation in the same unit; null if unknown")
    valid: bool = Field(
        description="true: data have determined the value, with a std below the limit that ``reason`` gives otherwise; a7..a12 also need time "
        "constants from data. A configured value is never valid"
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
