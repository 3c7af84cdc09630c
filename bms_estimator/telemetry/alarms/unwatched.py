"""Alarms that cannot be watched, because a quantity that they need is no longer measured."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from bms_estimator.settings.alarm_kinds import ALARM_KINDS, Quantity
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.telemetry.alarms.inputs import Inputs
from bms_estimator.telemetry.alarms.sensor_faults import FaultyInput

LOSS_TEXTS: dict[FaultyInput, str] = {
    "voltage": "the voltage is no longer measured",
    "current": "the current is no longer measured",
    "temperature": "the temperature is no longer measured",
    "cells": "cell voltages are missing that were measured before",
}
"""Description of the loss, by quantity."""


@dataclass(frozen=True)
class UnwatchedAlarms:
    """Alarms that cannot be watched.

    Attributes:
        reasons: Reason by alarm.
        loss_texts: Lost quantities, each with the alarms that need it, one sentence each.
    """

    reasons: dict[AlarmName, str] = field(default_factory=dict)
    loss_texts: tuple[str, ...] = ()


def find_unwatched(
    names: Iterable[AlarmName], inputs: Inputs, silence_reason: str, input_faults: Mapping[FaultyInput, str]
) -> UnwatchedAlarms:
    """Return the alarms that cannot be watched because of silence or the loss of a quantity.

    Args:
        names: Names of the defined alarms.
        inputs: State of the measured quantities.
        silence_reason: Reason why no samples arrive; empty while they arrive.
        input_faults: Description of each fault of the input, by quantity.
    """
    lost = inputs.lost
    texts = LOSS_TEXTS | dict(input_faults)
    reasons: dict[AlarmName, str] = {}
    for name in names:
        needed = ALARM_KINDS[name].needs
        missing = [texts[each] for each in needed if each in lost]
        if missing:
            reasons[name] = "; ".join(missing)
        elif silence_reason and needed and inputs.were_measured(needed):
            reasons[name] = silence_reason
    return UnwatchedAlarms(reasons, tuple(_loss_text(each, texts[each], reasons) for each in lost))


def _loss_text(quantity: Quantity, text: str, unwatched: Iterable[AlarmName]) -> str:
    """Describe a lost quantity and the unwatched alarms that need it."""
    names = ", ".join(name for name in unwatched if quantity in ALARM_KINDS[name].needs)
    return f"{text}: {names} cannot be raised" if names else text
