"""``[alarms]`` of a pack's settings: limits, delays and hooks."""

from string import Template
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator

from bms_estimator.model.config_file import Fraction, NotNegative, Positive, Strict

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
    "hook_failed",
]
ALARMS: tuple[AlarmName, ...] = get_args(AlarmName)
"""Names of all alarms, in the order in which they are shown."""


class AlarmRule(Strict):
    """Settings of every alarm."""

    enabled: bool = True
    severity: Literal["warning", "critical"] = "warning"
    delay_s: NotNegative = Field(default=10.0, description="time at the limit after which the alarm is raised")
    clear_delay_s: NotNegative = Field(default=60.0, description="time beyond the clear level after which it ends")
    latch: bool = Field(default=False, description="true: stays raised until it is acknowledged")


class VoltageRule(AlarmRule):
    """Alarm on a voltage; default limits follow from the cell."""

    limit_v: Positive | None = None
    clear_v: Positive | None = None


class CurrentRule(AlarmRule):
    """Alarm on the magnitude of a current; default limits follow from the cell."""

    limit_a: Positive | None = None
    clear_a: NotNegative | None = None


class TemperatureRule(AlarmRule):
    """Alarm on a temperature."""

    limit_c: float | None = None
    clear_c: float | None = None


class FractionRule(AlarmRule):
    """Alarm on a quantity between 0 and 1."""

    limit: Fraction | None = None
    clear: Fraction | None = None


class LinkRule(AlarmRule):
    """Alarm on the time without a sample."""

    limit_s: Positive | None = None


class AlarmHook(Strict):
    """Action when alarms are raised and end: run a program, publish a message, or switch the board's relay."""

    alarms: tuple[AlarmName, ...] = Field(default=(), description="names of alarms; default: all but hook_failed")
    on: tuple[Literal["raised", "cleared"], ...] = Field(
        default=("raised", "cleared"), description="changes at which a program is run or a message published"
    )
    run: tuple[Annotated[str, Field(min_length=1)], ...] | None = Field(
        default=None, description="program and its arguments; no shell"
    )
    timeout_s: Annotated[float, Field(gt=0, le=3600)] = Field(
        default=10.0, description="time after which a program and its child processes are killed"
    )
    pass_environment: tuple[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], ...] = Field(
        default=(), description="further environment variables of the service that a program gets"
    )
    topic: Annotated[str, Field(pattern=r"^[^+#\s]{1,200}$")] | None = Field(
        default=None, description="topic of a message at QoS 1, not retained"
    )
    payload: str = Field(
        default="$json", description="payload of the message; $json, $name, $state, $text and others are substituted"
    )
    relay: Literal["high", "low"] | None = Field(
        default=None,
        description="level of the board's relay pin while one of the alarms is active; otherwise the opposite level",
    )
    when_silent: Literal["keep", "high", "low"] | None = Field(
        default=None,
        description="level of the pin after the board has received nothing from the service for silent_s; "
        "default: relay, the safe side",
    )
    silent_s: Annotated[int, Field(ge=15, le=3600)] = 30
    dry_run: bool = Field(default=False, description="true: only log the action")

    @property
    def level_when_silent(self) -> Literal["keep", "high", "low"] | None:
        """Level of the relay pin while the service is silent; None for a hook without a relay."""
        return self.when_silent or self.relay

    @model_validator(mode="after")
    def _one_of_three(self) -> Self:
        actions = [name for name in ("run", "topic", "relay") if getattr(self, name)]
        if len(actions) != 1:
            raise ValueError("give exactly one of run, topic and relay")
        try:
            Template(self.payload).substitute(dict.fromkeys(PAYLOAD_FIELDS, ""))
        except (KeyError, ValueError) as error:
            known = ", ".join(f"${name}" for name in PAYLOAD_FIELDS)
            raise ValueError(f"payload: {error}: must be one of {known}, or $$ for a $") from None
        return self


PAYLOAD_FIELDS = ("json", "device", "state", "name", "severity", "since", "value", "limit", "unit", "text")
"""Fields that a message's payload may name. ``state`` is ``raised`` or ``cleared``."""


class AlarmSettings(Strict):
    """Limits of alarms; a table for each, as in pack_over_voltage = {limit_v = 29.2, delay_s = 5}. docs/pack/alarms.md."""

    pack_over_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=2.0, clear_delay_s=10.0, latch=True)
    pack_under_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=5.0, clear_delay_s=30.0)
    cell_over_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=2.0, clear_delay_s=10.0, latch=True)
    cell_under_voltage: VoltageRule = VoltageRule(severity="critical", delay_s=5.0, clear_delay_s=30.0)
    discharge_over_current: CurrentRule = CurrentRule(severity="critical", latch=True)
    charge_over_current: CurrentRule = CurrentRule(severity="critical", latch=True)
    over_temperature: TemperatureRule = TemperatureRule(severity="critical")
    under_temperature: TemperatureRule = TemperatureRule()
    charging_below_freezing: TemperatureRule = TemperatureRule(severity="critical", clear_delay_s=10.0, latch=True)
    soc_low: FractionRule = FractionRule()
    stability_margin_low: FractionRule = FractionRule()
    cell_imbalance: VoltageRule = VoltageRule(delay_s=60.0)
    sensor_fault: FractionRule = Field(
        default=FractionRule(clear_delay_s=30.0), description="limit: fraction of samples that are lost or unusable"
    )
    model_mismatch: VoltageRule = Field(
        default=VoltageRule(delay_s=60.0),
        description="limit_v: innovation of the pack, measured minus predicted voltage",
    )
    link_lost: LinkRule = Field(
        default=LinkRule(delay_s=0.0, clear_delay_s=5.0),
        description="limit_s: time without a sample; default: 10 s or 3 periods, whichever is longer",
    )

    hook_failed: AlarmRule = Field(
        default=AlarmRule(clear_delay_s=10.0),
        description="raised while the last run of a hook failed",
    )

    lost_s: NotNegative = Field(
        default=10.0,
        description="time without a value after which a quantity counts as lost, and time with values after which it counts as restored",
    )
    hook: tuple[AlarmHook, ...] = Field(
        default=(), description="actions when an alarm is raised or cleared, as [[alarms.hook]]; default: none"
    )

    @model_validator(mode="after")
    def _one_relay(self) -> Self:
        if sum(hook.relay is not None for hook in self.hook) > 1:
            raise ValueError("hook: the board has one relay; give one hook with all its alarms")
        return self

    @model_validator(mode="before")
    @classmethod
    def _merge_defaults(cls, table: object) -> object:
        """Fill an alarm's missing settings from the alarm's defaults, not from those of its class."""
        if not isinstance(table, dict):
            return table
        return {
            name: _merged(cls.model_fields[name].default, value) if name in ALARMS else value
            for name, value in table.items()
        }


def _merged(default: AlarmRule, rule: Any) -> Any:
    """Merge an alarm's settings into its defaults."""
    if not isinstance(rule, dict):
        return rule
    return default.model_dump(exclude_none=True) | rule
