"""Base class of the settings of sources, and those of a Linux computer's battery sensor and of a BMS over Bluetooth."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bms_estimator.model.config_file import Positive, Strict, suggestion

Name = Annotated[str, Field(min_length=1)]


class BaseSource(Strict):
    """Base class of all kinds of ``[source]``, which are the devices and programs that are not on a serial port."""

    @property
    def period_s(self) -> float:
        """Expected time between two samples [s]; a value is stale after three such periods."""
        raise NotImplementedError

    @property
    def short_description(self) -> str:
        """Description in a few words."""
        raise NotImplementedError

    @property
    def sensor_defaults(self) -> Mapping[str, object]:
        """Return the ``[sensor]`` defaults of the source: resolution, sign of the current."""
        return {}


def as_tuple(value: object) -> object:
    """Return a list unchanged, and another value as a tuple of one item, because a quantity may have one location or several."""
    return value if isinstance(value, list | tuple) else () if value is None else (value,)


def merge_profile(table: object, profiles: Mapping[str, Mapping[str, object]]) -> object:
    """Return a table ``[source]`` with the defaults of the profile that it names; other tables are returned unchanged.

    Args:
        table: Table before its validation.
        profiles: Defaults of ``[source]`` by the name of the profile.

    Raises:
        ValueError: The profile is unknown.
    """
    if not isinstance(table, dict) or not isinstance(name := table.get("profile"), str):
        return table
    if name not in profiles:
        raise ValueError(f"profile: {name!r} must be one of {', '.join(profiles)}{suggestion(name, profiles)}")
    return {**profiles[name], **table}


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
