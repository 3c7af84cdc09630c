"""Builder of MQTT messages from a snapshot and the state already published. Pure: no connection, no clock."""

import json
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from bms_estimator.model.events import events
from bms_estimator.model.payloads.health import Health
from bms_estimator.model.payloads.payload import Payload
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.message import Message
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.home_assistant import HomeAssistantSettings
from bms_estimator.sinks.home_assistant.discovery import (
    VALUES,
    DiscoveryInputs,
    check_names,
    discovery,
    discovery_topic,
)
from bms_estimator.sinks.home_assistant.entity_values import EntityStates, values_to_publish
from bms_estimator.sinks.mqtt.topics import schema
from bms_estimator.sinks.mqtt.venus_os import venus_battery

AVAILABILITY = "availability"
"""Topic of the service's availability, below the device's topic."""
SENSOR_AVAILABILITY = "sensor/availability"
"""Topic of the sensor's availability, below the device's topic."""
VENUS = "venus"
"""Topic of the battery for Venus OS, below the device's topic."""
ANNOUNCED_ALARMS = ("collapse_risk",)
"""Alarms with an entity in Home Assistant before their first value, which follows only after minutes of load."""


UNRETAINED = "parameters", "forecast"
"""Topics of ``changed_payloads`` whose messages are not retained."""


def changed_payloads(before: Snapshot | None, snapshot: Snapshot) -> Iterator[tuple[str, Payload]]:
    """Yield topic and payload of each part of a snapshot that has changed, without state and events.

    Args:
        before: Previous snapshot of the receiver; None for the first one.
        snapshot: The snapshot.
    """
    parameters = snapshot.parameters if snapshot.parameters.elements else None  # none before the first sample
    for topic in ("parameters", "forecast", "health", "info", "cells"):
        payload, former = (
            parameters if topic == "parameters" else getattr(snapshot, topic),
            getattr(before, topic, None),
        )
        # all but info have a publish time, so that each new object is published
        if payload is not None and payload is not former and (topic != "info" or payload != former):
            yield topic, payload
    published = {alarm.name: alarm for alarm in before.alarms} if before else {}
    for alarm in snapshot.alarms:
        if alarm != published.get(alarm.name):
            yield f"alarm/{alarm.name}", alarm


class PublishedState(NamedTuple):
    """State that the broker has; initially empty."""

    snapshot: Snapshot | None = None
    entity_states: EntityStates = EntityStates()
    discovery_inputs: DiscoveryInputs | None = None
    """Data of the last discovery message."""


class MessageBuilder:
    """Builder of the messages of one pack.

    Args:
        base_topic: First part of all topics.
        device: Name of the pack.
        sample_period_s: Sample period if it may exceed the publish period, otherwise 0 [s]. Home Assistant's values
            expire later with a longer period.
        home_assistant: Settings of Home Assistant.
        alarms: Monitored alarms; retained messages of others are removed.
        venus_limits: Limits for Venus OS (``venus_battery``); None: nothing is published for it.

    Attributes:
        root: Root of all topics.
        commands: Allowed commands.

    Raises:
        UserError: ``home_assistant`` names an unknown entity.
    """

    def __init__(
        self,
        base_topic: str,
        device: str,
        sample_period_s: float = 0.0,
        home_assistant: HomeAssistantSettings | None = None,
        alarms: Collection[str] = ALARMS,
        venus_limits: Mapping[str, float] | None = None,
    ) -> None:
        self._venus_limits = venus_limits
        self._unwatched = tuple(name for name in ALARMS if name not in alarms)
        self._announced = {name for name in ANNOUNCED_ALARMS if name in alarms}
        self.root = f"{base_topic}/{device}"
        self.commands: tuple[str, ...] = ()
        self._home_settings = home_assistant or HomeAssistantSettings()
        check_names(self._home_settings)
        self._device, self._sample_period_s = device, sample_period_s
        self._schema = _schema()  # takes milliseconds, which would delay the event loop later

    def birth_messages(self) -> list[Message]:
        """Return the first messages of a connection."""
        removed = [self._retained(f"alarm/{name}", b"") for name in self._unwatched]
        return [self._retained(AVAILABILITY, b"online"), self._retained("schema", self._schema), *removed]

    def offline_messages(self) -> list[Message]:
        """Return the last messages of a connection. The last of them is also the will."""
        return [self._retained(SENSOR_AVAILABILITY, b"offline"), self._retained(AVAILABILITY, b"offline")]

    def availability(self, sent: PublishedState) -> list[Message]:
        """Return both availabilities, which another client may have overwritten."""
        sensor = [self._sensor(sent.snapshot.health)] if sent.snapshot else []
        return [self._retained(AVAILABILITY, b"online"), *sensor]

    def guaranteed_messages(self, before: Snapshot | None, snapshot: Snapshot) -> list[Message]:
        """Return the messages of a snapshot that must reach the broker, late if necessary, with their own timestamps.

        Args:
            before: Previous snapshot; None for the first one.
            snapshot: Snapshot to publish.
        """
        event_messages = [self._queued("event", event) for event in events(before, snapshot)]
        return event_messages + ([self._queued("state", snapshot.estimate)] if snapshot.estimate else [])

    def live_messages(
        self, sent: PublishedState, snapshot: Snapshot, now_s: float
    ) -> tuple[list[Message], PublishedState]:
        """Return the messages that are not in ``guaranteed_messages`` and differ from what the broker has.

        Args:
            sent: State that the broker has.
            snapshot: The snapshot.
            now_s: Monotonic clock [s].

        Returns:
            The messages, and the state that the broker has after them.
        """
        messages, before = [], sent.snapshot
        for topic, payload in changed_payloads(before, snapshot):
            if topic == "health" and (before is None or before.health.sensor_online != snapshot.health.sensor_online):
                messages.append(self._sensor(snapshot.health))
            messages.append((self._live if topic in UNRETAINED else self._retained)(topic, payload.json_bytes))
        discovery_inputs = self._discovery_inputs(sent, snapshot)
        if discovery_inputs != sent.discovery_inputs:
            text = self._discovery(discovery_inputs)
            if sent.discovery_inputs is None or text != self._discovery(sent.discovery_inputs):
                messages.append(Message(discovery_topic(self._home_settings, self._device), text, qos=1, retain=True))
        if snapshot.estimate and self._venus_limits is not None:
            battery = venus_battery(snapshot.estimate, snapshot.info, snapshot.alarms, self._venus_limits)
            messages += [self._live(VENUS, _json(battery))] if battery else []
        values, entity_states = self._home_assistant(sent.entity_states, snapshot, discovery_inputs, now_s)
        return messages + values, PublishedState(snapshot, entity_states, discovery_inputs)

    def _discovery_inputs(self, sent: PublishedState, snapshot: Snapshot) -> DiscoveryInputs:
        """Return the discovery data of a snapshot. The number of cells never decreases."""
        cells = len((snapshot.estimate and snapshot.estimate.cells_v) or ())
        known_cells = sent.discovery_inputs.cells if sent.discovery_inputs else 0
        names = {alarm.name for alarm in snapshot.alarms} | self._announced
        alarms = tuple(name for name in ALARMS if name in names)
        return DiscoveryInputs(snapshot.info, max(cells, known_cells), alarms, self.commands, self._unwatched)

    def _home_assistant(
        self, before: EntityStates, snapshot: Snapshot, discovery_inputs: DiscoveryInputs, now_s: float
    ) -> tuple[list[Message], EntityStates]:
        if not self._home_settings.enabled:
            return [], before
        sign = 1.0 if self._home_settings.current_sign == "discharge_positive" else -1.0
        entity_states = values_to_publish(before, snapshot, discovery_inputs, now_s, sign=sign)
        return ([] if entity_states is before else [self._live(VALUES, _json(entity_states.values))]), entity_states

    def _sensor(self, health: Health) -> Message:
        return self._retained(SENSOR_AVAILABILITY, b"online" if health.sensor_online else b"offline")

    def _discovery(self, discovery_inputs: DiscoveryInputs) -> bytes:
        """Return the discovery payload. It is empty, which removes the device, if discovery is disabled."""
        return (
            _json(discovery(self._home_settings, discovery_inputs, self.root, self._sample_period_s))
            if self._home_settings.enabled
            else b""
        )

    def _queued(self, topic: str, report: Payload) -> Message:
        return Message(f"{self.root}/{topic}", report.json_bytes, qos=1, retain=False)

    def _live(self, topic: str, payload: bytes) -> Message:
        return Message(f"{self.root}/{topic}", payload, qos=0, retain=False)

    def _retained(self, topic: str, payload: bytes) -> Message:
        return Message(f"{self.root}/{topic}", payload, qos=1, retain=True)


@cache
def _schema() -> bytes:
    """Return the schema, which is equal for all packs."""
    return _json(schema())


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
