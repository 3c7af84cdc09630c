"""Payload of the topics ``alarm/<name>``."""

from typing import Literal

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload


class Alarm(Payload):
    """Topic ``alarm/<name>``, retained: one alarm of a pack, raised or not."""

    name: str = Field(description="name in the topic and in [alarms]")
    severity: Literal["warning", "critical"]
    active: bool = Field(description="true: raised, and not yet cleared or, if it latches, acknowledged")
    latched: bool = Field(description="true: the cause is gone, and the alarm waits for an acknowledgment")
    since: str | None = Field(description="time at which it was raised, ISO 8601, UTC; null unless active")
    value: float | None = Field(description="measured value when it was raised, in unit; null without a number")
    limit: float | None = Field(description="limit, in unit; null without a number")
    unit: str | None = Field(description="unit of value and limit")
    text: str = Field(description="description and remedy; empty unless active")
    watched: bool = Field(
        default=True,
        description="false: a required quantity was measured before and is missing, so the alarm cannot be raised",
    )
    unwatched_reason: str | None = Field(default=None, description="reason why it is not watched; null while it is")
    unknown_reason: str | None = Field(
        default=None,
        description="reason why its value is not known, for example because the SOC is not, so that it is neither raised nor "
        "cleared; null while it is known",
    )
