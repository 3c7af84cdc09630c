"""``[alarms]`` of a pack's settings: what is watched, from where on, for how long."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from bms_estimator.model.toml_file import Strict

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
AlarmName = Literal[
    "pack_over_voltage",
    "pack_under_voltage",
    "cell_over_voltage",
    "cell_under_voltage",
    "discharge_over_current",
    "charge_over_current",
    "over_temperature",
    "under_temperature",
    "charging_below_freezing",
    "soc_low",
    "stability_margin_low",
    "cell_imbalance",
    "sensor_fault",
    "model_mismatch",
    "link_lost",
]
ALARMS: tuple[AlarmName, ...] = get_args(AlarmName)
"""All alarms that there are, in the order in which they are shown."""


class AlarmRule(Strict):
    """What all alarms have."""

    enabled: bool = True
    severity: Literal["warning", "critical"] = "warning"
    delay_s: NotNegative = Field(default=10.0, description="so long the limit must be reached until it is raised")
    clear_delay_s: NotNegative = Field(default=60.0, description="so long it must be back beyond clear until it ends")
    latch: bool = Field(default=False, description="stays until it is acknowledged")


class VoltageRule(AlarmRule):
    """An alarm of a voltage; what is left out follows from the cell."""

    limit_v: Positive | None = None
    clear_v: Positive | None = None


class CurrentRule(AlarmRule):
    """An alarm of a current's magnitude; what is left out follows from the cell."""

    limit_a: Positive | None = None
    clear_a: NotNegative | None = None


class TemperatureRule(AlarmRule):
    """An alarm of a temperature."""

    limit_c: float | None = None
    clear_c: float | None = None


class ShareRule(AlarmRule):
    """An alarm of something between 0 and 1."""

    limit: Fraction | None = None
    clear: Fraction | None = None


class LinkRule(AlarmRule):
    """An alarm of silence: its limit is its delay."""

    limit_s: Positive | None = None


class AlarmSettings(Strict):
    """What is an alarm; a table for each, as in pack_over_voltage = {limit_v = 29.2, delay_s = 5}. docs/alarms.md."""

    pack_over_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=2.0, clear_delay_s=10.0, latch=True)
    pack_under_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=5.0, clear_delay_s=30.0)
    cell_over_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=2.0, clear_delay_s=10.0, latch=True)
    cell_under_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=5.0, clear_delay_s=30.0)
    discharge_over_current: CurrentRule = CurrentRule(severity="critical", latch=True)
    charge_over_current: CurrentRule = CurrentRule(severity="critical", latch=True)
    over_temperature: TemperatureRule = TemperatureRule(severity="critical")
    under_temperature: TemperatureRule = TemperatureRule()
    charging_below_freezing: TemperatureRule = TemperatureRule(severity="critical", clear_delay_s=10.0, latch=True)
    soc_low: ShareRule = ShareRule()
    stability_margin_low: ShareRule = ShareRule()
    cell_imbalance: VoltageRule = VoltageRule(delay_s=60.0)
    sensor_fault: ShareRule = Field(
        default=ShareRule(clear_delay_s=30.0), description="limit: share of samples that are lost or unusable"
    )
    model_mismatch: VoltageRule = Field(
        default=VoltageRule(delay_s=60.0), description="limit_v: of the pack's innovation, measured less predicted"
    )
    link_lost: LinkRule = Field(
        default=LinkRule(delay_s=0.0, clear_delay_s=5.0),
        description="limit_s: without a sample; 10 s, or 3 periods where that is longer",
    )

    @model_validator(mode="before")
    @classmethod
    def _over_its_own_defaults(cls, table: object) -> object:
        """What an alarm's table leaves out is as that alarm has it, not as its kind has it."""
        if not isinstance(table, dict):
            return table
        return {
            name: _completed(cls.model_fields[name].default, told) if name in ALARMS else told
            for name, told in table.items()
        }


def _completed(default: AlarmRule, told: Any) -> Any:
    """What was told of an alarm over its defaults."""
    if not isinstance(told, dict):
        return told
    return default.model_dump(exclude_none=True) | told
