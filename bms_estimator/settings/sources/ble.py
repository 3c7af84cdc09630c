"""BMS that is polled over Bluetooth: ``[source]`` with ``kind = "ble"``."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from bms_estimator.settings.sources.source import BaseSource

VOLTAGE_RESOLUTION_V = 0.01
"""Voltage resolution of JBD [V]; that of JK is finer."""
CURRENT_RESOLUTION_A = 0.01
"""Current resolution of JBD [A]; that of JK is finer, that of Daly is 0.1 A."""


class BleSource(BaseSource):
    """BMS over Bluetooth Low Energy; requires Python 3.12."""

    kind: Literal["ble"] = Field(description="kind of this source")
    address: Annotated[str, Field(pattern=r"^[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}$")] | None = Field(
        default=None, description='address of the BMS, such as "A4:C1:38:00:11:22"; either address or name is required'
    )
    name: Annotated[str, Field(min_length=1)] | None = Field(default=None, description="name that the BMS advertises")
    bms: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")] | None = Field(
        default=None,
        description='device type, as aiobmsble names it: "jbd", "jikong", "daly", ...; default: recognized by the advertisement of the BMS',
    )
    poll_s: Annotated[float, Field(ge=0.5, le=600)] = Field(default=2.0, description="interval between two readings")

    @model_validator(mode="after")
    def _check_address_or_name(self) -> Self:
        if (self.address is None) == (self.name is None):
            raise ValueError("give either address or name")
        return self

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]."""
        return self.poll_s

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        return f"BMS {self.address or self.name} over Bluetooth"

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults; aiobmsble reports charge as positive for every BMS."""
        return {
            "current_sign": "charge_positive",
            "voltage_resolution_v": VOLTAGE_RESOLUTION_V,
            "current_resolution_a": CURRENT_RESOLUTION_A,
        }
