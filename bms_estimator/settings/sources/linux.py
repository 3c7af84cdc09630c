"""Current sensor of this machine: ``[source]`` with ``kind = "linux"``."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from bms_estimator.model.config_file import Positive
from bms_estimator.settings.sources.source import BaseSource, Name, as_tuple

RESOLUTION_V = {"ina219": 4e-3, "ina220": 4e-3, "ads1015": 2e-3}
"""Voltage resolution at the pins by chip [V], from the data sheet of the INA219; for the ADS1015, at 4.096 V full scale."""
DEFAULT_RESOLUTION_V = 1.25e-3
"""Voltage resolution of the INA226 [V], used for all chips that are not in ``RESOLUTION_V``."""
DEFAULT_INTERVAL_S = 1.0
"""Sample period of a chip without an update interval [s]. The interval of a chip is not known before it is opened."""


class LinuxSource(BaseSource):
    """Current sensor with a driver in the kernel: INA2xx (hwmon) or ADS1x15 (iio)."""

    kind: Literal["linux"] = Field(description="kind of this source")
    chip: Name = Field(
        default="ina226", description="name of the chip, its bus address such as 1-0040, or its folder in sysfs"
    )
    voltage: Name = Field(
        default="in1_input",
        description="hwmon file with the voltage, such as in1_input, or iio channel, such as in_voltage0, of chip; write chip/file for another chip",
    )
    current: Name = Field(
        default="curr1_input",
        description="file or channel of the current, written like voltage; shunt_ohm is required if it is a voltage across the shunt",
    )
    temperature: Annotated[tuple[Name, ...], BeforeValidator(as_tuple)] = Field(
        default=(),
        description="file or channel of the pack's temperature (not the chip's), such as temp1_input, written like voltage; a list for several probes",
    )
    voltage_scale: Positive = Field(
        default=1.0, description="ratio of the voltage divider: pack voltage / voltage at the chip"
    )
    voltage_offset_v: float = Field(
        default=0.0, description="offset that is added to the pack voltage after voltage_scale"
    )
    current_scale: Positive = Field(
        default=1.0, description="factor of the current that corrects the shunt's tolerance"
    )
    current_offset_a: float = Field(default=0.0, description="offset that is added to the current after current_scale")
    shunt_ohm: Positive | None = Field(
        default=None, description="resistance of the shunt; default: the resistance that the driver assumes"
    )
    interval_s: Annotated[float, Field(ge=0.01, le=3600)] | None = Field(
        default=None,
        description="sample period; default: update interval of the chip, but at least 0.1 s; 1 s if the chip has no update interval",
    )

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s], before the update interval of the chip is known."""
        return self.interval_s or DEFAULT_INTERVAL_S

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        return f"{self.chip} of this machine"

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults: the chip's voltage resolution times the ratio of the divider."""
        return {"voltage_resolution_v": RESOLUTION_V.get(self.chip, DEFAULT_RESOLUTION_V) * self.voltage_scale}
