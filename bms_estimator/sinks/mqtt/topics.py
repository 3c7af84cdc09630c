"""Topics of all payloads, and their common version.

``PAYLOAD_VERSION`` increases by one when a topic or field disappears, or a field gets another type, unit or meaning.
An addition does not increase it: readers ignore unknown fields.
``tests/sinks/mqtt/test_payloads.py`` checks that no field changes.
"""

from typing import Any, NamedTuple

from bms_estimator.model.events import Event
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.health import PAYLOAD_VERSION, Health, Payload
from bms_estimator.model.payloads.snapshot import Alarm, CellsReport, ForecastReport, Info, ParameterReport


class Topic(NamedTuple):
    """Topic whose payload is a model."""

    model: type[Payload]
    qos: int
    retain: bool
    when: str
    """Description of the publish times."""


TOPICS = {
    "state": Topic(Estimate, 1, retain=False, when="each publish period with samples; late after an outage"),
    "event": Topic(Event, 1, retain=False, when="when it happens; late after an outage"),
    "parameters": Topic(ParameterReport, 0, retain=False, when="each second, from the first sample on"),
    "forecast": Topic(ForecastReport, 0, retain=False, when="once a minute, from the first sample on"),
    "health": Topic(Health, 1, retain=True, when="each second, and when the sensor comes or goes"),
    "info": Topic(Info, 1, retain=True, when="on change"),
    "cells": Topic(CellsReport, 1, retain=True, when="each minute, with cell voltages"),
    "alarm": Topic(Alarm, 1, retain=True, when="on change"),
}
"""Payload models by topic; each alarm has a topic below ``alarm/``."""


def schema() -> dict[str, Any]:
    """Return the payload of topic ``schema``: the version, and the JSON schema of each topic's payload."""
    schemas = {name: topic.model.model_json_schema() for name, topic in TOPICS.items()}
    return {"payload_version": PAYLOAD_VERSION} | schemas
