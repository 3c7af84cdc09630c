"""``[sensor]``: the measuring device."""

from typing import Annotated, Literal, Self

from pydantic import Field, ModelWrapValidatorHandler, model_validator

from bms_estimator.model.config_file import NotNegative, OneOf, Positive, Strict
from bms_estimator.protocols.base.reading_protocol import SensorCorrection
from bms_estimator.protocols.registry import BOARD, DEVICES, PROTOCOLS, max_batteries, valid_addresses
from bms_estimator.settings.observer import BOARD_GAIN_STD

ALLOWED_WITH_SOURCE = {"port": ("auto",), "protocol": ("binary", "text"), "serial": (None,), "address": (None,)}
"""Values that settings of a serial device may have if there is a ``[source]``, by setting. The first value is the
default, so that a file that contains all defaults is valid. The protocol text is allowed, because a ``[source]`` sets it."""


MAX_GAIN_STD = 0.2
"""Maximum relative std of a gain. A sensor with a larger error must be calibrated."""
GainStd = Annotated[float, Field(ge=0.0, le=MAX_GAIN_STD)]
MIN_GAIN, MAX_GAIN = 0.5, 2.0
"""Range of a gain. A factor beyond it is a wrong unit or a wrong divider."""
Gain = Annotated[float, Field(ge=MIN_GAIN, le=MAX_GAIN)]


def _with_device_defaults(sensor: dict[str, object]) -> dict[str, object]:
    """Return the table ``[sensor]`` with the resolution and the gain errors of the device, unless configured."""
    protocol = sensor.get("protocol")
    if not isinstance(protocol, str) or protocol not in DEVICES:
        return sensor
    declared = vars(DEVICES[protocol].sensor_defaults)
    return {name: value for name, value in declared.items() if value is not None} | sensor


class SensorSettings(Strict):
    """Sensor board, or BMS or meter on a serial port: port, protocol, resolution, sign of the current."""

    port: str = Field(
        default="auto",
        min_length=1,
        description="path of the serial port, preferably below /dev/serial/by-id; auto: port of the only connected board",
    )
    serial: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")] | None = Field(
        default=None,
        description='serial number of the board, as `bms-estimator board` prints it, such as "0000002a"; default: serial number of the first board that connects, which the service stores',
    )
    protocol: Annotated[str, OneOf(PROTOCOLS)] = Field(
        default=BOARD,
        description=f"binary: board with this project's firmware; text: board that prints text lines; otherwise the BMS or meter: {', '.join(name for name in DEVICES if name != 'text')}",
    )
    address: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="address of the BMS on a shared RS485 line, for daly (board number) and jk; default: the first address that responds",
    )
    batteries: Annotated[int, Field(ge=1)] | None = Field(
        default=None,
        description="number of batteries in parallel that the console of a pylontech stack reports; a table with fewer is rejected; default: pack.parallel, if it is 2 or more",
    )
    baud: Annotated[int, Field(ge=1200, le=10_000_000)] = Field(
        default=500_000, description="baud rate of the serial port; default: depends on the protocol"
    )
    sample_rate_hz: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=100, description="sample rate that is requested from a board with the protocol binary"
    )
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive",
        description="direction of positive current in the values of the device, or in the columns of a table; default: depends on the protocol",
    )
    voltage_resolution_v: Positive = Field(
        default=25.0 / 1024,  # 10-bit converter behind a common divider module for 0 to 25 V
        description="voltage resolution (LSB); default: that of the device",
    )
    voltage_noise_v: NotNegative | None = Field(
        default=None,
        description="standard deviation of the noise of one voltage sample; default: half of voltage_resolution_v",
    )
    current_resolution_a: NotNegative | None = Field(
        default=None,
        description="current resolution (LSB); default: that of the device; 0 for a board, whose resolution is negligible",
    )
    current_dead_band_a: NotNegative | None = Field(
        default=None,
        description="the device reports currents below this magnitude as 0; default: that of the device, otherwise 0",
    )
    voltage_gain_std: GainStd = Field(
        default=BOARD_GAIN_STD,
        description="relative standard deviation of the voltage's gain, 0.01 for a voltage that may be 1 % wrong; default: that of the device, 0.005 except for a board, which is calibrated",
    )
    current_gain_std: GainStd = Field(
        default=BOARD_GAIN_STD,
        description="relative standard deviation of the current's gain; default: that of the device, 0.005 except for a board, which is calibrated",
    )
    voltage_gain: Gain = Field(
        default=1.0,
        description="factor by which the measured pack voltage is multiplied, from a comparison with a multimeter; cell voltages are not changed",
    )
    current_gain: Gain = Field(
        default=1.0, description="factor by which the measured current is multiplied after current_zero_a is subtracted"
    )
    current_zero_a: float = Field(
        default=0.0, description="current that the device reports while no current flows, with the sign of the device"
    )
    period_s: Positive | None = Field(
        default=None, description="sample period of a device that sends at a fixed rate; default: that of the device"
    )

    @model_validator(mode="wrap")
    @classmethod
    def _add_device_defaults(cls, table: object, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Add the device's defaults without marking them as set, so that ``exclude_unset`` leaves them out."""
        if not isinstance(table, dict):
            return validate(table)
        settings = validate(_with_device_defaults(table))
        settings.model_fields_set.intersection_update(table)
        return settings

    @model_validator(mode="after")
    def _check_serial(self) -> Self:
        if self.serial and self.protocol != "binary":
            raise ValueError(
                f"serial: only a binary board reports its serial number, but sensor.protocol is {self.protocol}; remove serial"
            )
        return self

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        addresses = valid_addresses(self.protocol)
        if self.address is None or self.address in addresses:
            return self
        if not addresses:
            raise ValueError(f"address: the protocol {self.protocol} has no addresses; remove address")
        raise ValueError(f"address: {self.protocol} has addresses {addresses[0]} to {addresses[-1]}")

    @model_validator(mode="after")
    def _check_batteries(self) -> Self:
        if self.batteries is not None and self.batteries > (limit := max_batteries(self.protocol)):
            raise ValueError(f"batteries: the protocol {self.protocol} has at most {limit}")
        return self

    @property
    def correction(self) -> SensorCorrection:
        """Correction of samples, whose current is positive on discharge."""
        sign = 1.0 if self.current_sign == "discharge_positive" else -1.0
        return SensorCorrection(self.voltage_gain, self.current_gain, sign * self.current_zero_a)

    @property
    def sample_period_s(self) -> float:
        """Time between two samples [s]."""
        return self.period_s or 1.0 / self.sample_rate_hz
