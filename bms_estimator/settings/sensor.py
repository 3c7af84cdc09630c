"""``[sensor]``: the device that measures."""

from typing import Annotated, Literal, Self

from pydantic import Field, ModelWrapValidatorHandler, model_validator

from bms_estimator.model.config_file import NotNegative, Positive, Strict
from bms_estimator.model.one_of import OneOf
from bms_estimator.protocols.registry import BOARD, DEVICES, PROTOCOLS

NO_DEVICE = {"port": ("auto",), "protocol": ("binary", "text"), "serial": (None,), "address": (None,)}
"""Values of ``[sensor]`` that are allowed beside ``[source]``: those of a file with all defaults."""


def _filled(sensor: dict[str, object]) -> dict[str, object]:
    """Fill in the device's resolution where the table ``[sensor]`` leaves it out."""
    protocol = sensor.get("protocol")
    if not isinstance(protocol, str) or protocol not in DEVICES:
        return sensor
    declared = vars(DEVICES[protocol].resolution)
    return {name: value for name, value in declared.items() if value is not None} | sensor


class SensorSettings(Strict):
    """The board, what it resolves, and its sign of current."""

    port: str = Field(
        default="auto", description="device path, best under /dev/serial/by-id; auto: the only board found"
    )
    serial: Annotated[str, Field(pattern=r"^[0-9a-f]{8}$")] | None = Field(
        default=None,
        description='the only board that is taken, as `bms-estimator board` shows its number, such as "0000002a"; '
        "the first that came, which is remembered, when left out",
    )
    protocol: Annotated[str, OneOf(PROTOCOLS)] = Field(
        default=BOARD, description="frames of the firmware, text lines, or a BMS or meter by its name"
    )
    address: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="of several packs on one RS485 line, the one that is taken; the first that answers when left out",
    )
    baud: Annotated[int, Field(ge=1200, le=10_000_000)] = Field(
        default=500_000, description="a device's own when left out"
    )
    sample_rate_hz: Annotated[int, Field(ge=1, le=1000)] = Field(default=100, description="asked of a binary board")
    current_sign: Literal["discharge_positive", "charge_positive"] = Field(
        default="discharge_positive",
        description="what the board, or a table, calls positive; inside, discharge is; a device's own when left out",
    )
    voltage_resolution_v: Positive = Field(
        default=25.0 / 1024, description="one step of the voltage converter; a device's own when left out"
    )
    voltage_noise_v: NotNegative | None = Field(
        default=None, description="standard deviation of one voltage sample; half a step when left out"
    )
    current_resolution_a: NotNegative | None = Field(
        default=None, description="one step of the current; a device's own when left out, of a board as good as none"
    )
    current_dead_band_a: NotNegative | None = Field(
        default=None, description="smaller currents are shown as 0; a device's own when left out, else none are"
    )
    period_s: Positive | None = Field(
        default=None, description="between two samples, where they come at their own pace; a device's when left out"
    )

    @model_validator(mode="wrap")
    @classmethod
    def _as_the_device_does(cls, table: object, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Fill in the protocol's defaults without counting them as set."""
        if not isinstance(table, dict):
            return validate(table)
        made = validate(_filled(table))
        made.model_fields_set.intersection_update(table)
        return made

    @model_validator(mode="after")
    def _only_boards_have_serials(self) -> Self:
        if self.serial and self.protocol != "binary":
            raise ValueError(
                f"serial: only a binary board tells its number, and protocol is {self.protocol}; leave it out"
            )
        return self

    @property
    def sample_period_s(self) -> float:
        """Time between two samples [s]."""
        return self.period_s or 1.0 / self.sample_rate_hz
