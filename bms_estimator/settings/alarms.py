"""``[alarms]`` of a pack's settings: limits, delays and hooks."""

from string import Template
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator

from bms_estimator.model.config_file import Fraction, NotNegative, Positive, Strict
from bms_estimator.settings.false_alarm_limits import DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH

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
    "collapse_risk",
    "stability_margin_low",
    "cell_imbalance",
    "weak_cell",
    "cell_short",
    "cell_sensor_fault",
    "sensor_fault",
    "model_mismatch",
    "link_lost",
    "hook_failed",
    "alarm_state_lost",
]
ALARMS: tuple[AlarmName, ...] = get_args(AlarmName)
"""Names of all alarms, in the order in which they are shown."""
HookEvent = Literal["raised", "cleared", "first_raised", "last_cleared"]
"""Event at which a hook acts: a change of one of its alarms, the first raised alarm, or the end of the last one."""
PAYLOAD_FIELDS = ("json", "device", "state", "name", "severity", "since", "value", "limit", "unit", "text", "raised")
"""Fields that the payload of a hook's message may contain, such as $state. ``state`` is ``raised`` or ``cleared``, and
``raised`` the names of the hook's raised alarms."""
HOOK_EXAMPLES = """\
[[alarms.hook]]
alarms = ["cell_over_voltage", "over_temperature"]
on = ["first_raised", "last_cleared"]  # cleared alone may be reported while another alarm is still raised
run = ["/usr/local/bin/charger"]
[[alarms.hook]]
alarms = ["pack_over_voltage", "over_temperature"]
relay = "low"  # the level after each reset and without power, so use low for critical alarms
when_silent = "low"
"""
"""Hooks that a new settings file shows as comments."""


class AlarmRule(Strict):
    """Settings of every alarm."""

    enabled: bool = True
    severity: Literal["warning", "critical"] = "warning"
    delay_s: NotNegative = Field(default=10.0, description="the alarm is raised after this time at or beyond its limit")
    clear_delay_s: NotNegative = Field(
        default=60.0, description="the alarm ends after this time within its clear level"
    )
    latch: bool = Field(default=False, description="true: the alarm stays raised until it is acknowledged")


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


class FalseAlarmRule(AlarmRule):
    """Alarm whose limit follows from the accepted rate of false alarms."""

    false_alarms_per_month: Positive = Field(
        default=1.0,
        description="accepted number of false alarms in a month of 60 h of use; a larger number warns earlier and more often",
    )


class LinkRule(AlarmRule):
    """Alarm on the time without a sample."""

    limit_s: Positive | None = None


class AlarmHook(Strict):
    """Action when alarms are raised and end: run a program, publish a message, or switch the board's relay."""

    alarms: tuple[AlarmName, ...] = Field(default=(), description="names of alarms; default: all but hook_failed")
    on: tuple[HookEvent, ...] = Field(
        default=("raised", "cleared"),
        description="changes at which the program is run or the message published: raised and cleared are those of each "
        "alarm; first_raised is the first of the alarms to be raised, last_cleared the end of the last raised one",
    )
    run: tuple[Annotated[str, Field(min_length=1)], ...] | None = Field(
        default=None, description="program to run and its arguments; no shell is used"
    )
    timeout_s: Annotated[float, Field(gt=0, le=3600)] = Field(
        default=10.0,
        description="time after which the program and its child processes are killed, or after which a message that the "
        "broker has not acknowledged makes the hook fail",
    )
    pass_environment: tuple[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], ...] = Field(
        default=(), description="names of further environment variables of the service that are passed to the program"
    )
    topic: Annotated[str, Field(pattern=r"^[^+#\s]{1,200}$")] | None = Field(
        default=None, description="MQTT topic of the message, which is sent at QoS 1 and not retained"
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
        description="level of the relay pin after the board has received nothing from the service for silent_s; "
        "default: the level in relay, which is the safe side",
    )
    silent_s: Annotated[int, Field(ge=15, le=3600)] = Field(
        default=30, description="time without a message from the service after which the board sets when_silent"
    )
    dry_run: bool = Field(default=False, description="true: only log the action")

    @property
    def level_when_silent(self) -> Literal["keep", "high", "low"] | None:
        """Level of the relay pin while the service is silent; None for a hook without a relay."""
        return self.when_silent or self.relay

    @model_validator(mode="after")
    def _check_action_and_payload(self) -> Self:
        actions = [name for name in ("run", "topic", "relay") if getattr(self, name)]
        if len(actions) != 1:
            raise ValueError("give exactly one of run, topic and relay")
        for event, event_of_any in (("raised", "first_raised"), ("cleared", "last_cleared")):
            if event in self.on and event_of_any in self.on:
                raise ValueError(f"on: give either {event} or {event_of_any}")
        try:
            Template(self.payload).substitute(dict.fromkeys(PAYLOAD_FIELDS, ""))
        except (KeyError, ValueError) as error:
            known = ", ".join(f"${name}" for name in PAYLOAD_FIELDS)
            raise ValueError(f"payload: {error}: must be one of {known}, or $$ for a $") from None
        return self


class AlarmSettings(Strict):
    """Alarms, each with a table such as pack_over_voltage = {limit_v = 29.2, delay_s = 5}. Default limits: docs/pack/alarms.md."""

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
    collapse_risk: FalseAlarmRule = Field(
        default=FalseAlarmRule(),
        description="probability of the cut-off within 5 min, by the forecast",
    )
    stability_margin_low: FractionRule = FractionRule()
    cell_imbalance: VoltageRule = VoltageRule(delay_s=60.0)
    weak_cell: FalseAlarmRule = Field(
        default=FalseAlarmRule(
            delay_s=0.0, clear_delay_s=0.0, false_alarms_per_month=DEFAULT_WEAK_CELL_FALSE_ALARMS_PER_MONTH
        ),
        description="deviation of a discharge from earlier ones in the direction of one weak cell, in standard deviations",
    )
    cell_short: CurrentRule = Field(
        default=CurrentRule(severity="critical", delay_s=60.0, clear_delay_s=600.0),
        description="limit_a: self-discharge current of a cell above that of the other cells",
    )
    cell_sensor_fault: VoltageRule = Field(
        default=VoltageRule(delay_s=60.0), description="limit_v: error of a cell's reading"
    )
    sensor_fault: FractionRule = Field(
        default=FractionRule(clear_delay_s=30.0), description="limit: fraction of samples that are lost or unusable"
    )
    model_mismatch: VoltageRule = Field(
        default=VoltageRule(delay_s=60.0),
        description="limit_v: difference between measured and predicted pack voltage",
    )
    link_lost: LinkRule = Field(
        default=LinkRule(delay_s=0.0, clear_delay_s=5.0),
        description="limit_s: time without a sample; default: 10 s, or three sample periods if these are longer",
    )
    hook_failed: AlarmRule = Field(
        default=AlarmRule(clear_delay_s=10.0),
        description="raised when a hook fails, until its next run succeeds",
    )

    lost_s: NotNegative = Field(
        default=10.0,
        description="a measured quantity, such as the temperature, counts as lost after this time without values, and as restored after this time with values",
    )
    hook: tuple[AlarmHook, ...] = Field(
        default=(),
        description="actions when an alarm is raised or cleared, each in a section [[alarms.hook]]; default: none",
        examples=[HOOK_EXAMPLES],
    )

    @model_validator(mode="after")
    def _check_relay_hooks(self) -> Self:
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
            name: _merge_rule(cls.model_fields[name].default, value)
            if name in ALARMS and name in cls.model_fields
            else value
            for name, value in table.items()
        }


def _merge_rule(default: AlarmRule, rule: Any) -> Any:
    """Return an alarm's defaults with the configured settings. A value that is not a table is left to the validation."""
    if not isinstance(rule, dict):
        return rule
    return default.model_dump(exclude_none=True) | rule
