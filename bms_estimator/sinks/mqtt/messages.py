"""Builder of MQTT messages from a snapshot and the state already published. Pure: no connection, no clock."""

import json
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any, NamedTuple

from bms_estimator.model.events import events
from bms_estimator.model.payloads import Health, Payload, Snapshot
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

AVAILABILITY = "availability"
"""Topic of the service's availability, below the device's topic."""
SENSOR_AVAILABILITY = "sensor/availability"
"""Topic of the sensor's availability, below the device's topic."""


class PublishedState(NamedTuple):
    """State that the broker has; initially empty."""

    snapshot: Snapshot | None = None
    shown: EntityStates = EntityStates()
    described: DiscoveryInputs | None = None
    """Data of the last discovery message."""


class MessageBuilder:
    """Builder of the messages of one pack.

    Args:
        base_topic: First part of all topics.
        device: Name of the pack.
        sample_period_s: Sample period, if it may exceed the publish period [s].
        home_assistant: Settings of Home Assistant.
        alarms: Monitored alarms; retained messages of others are removed.

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
    ) -> None:
        self._unwatched = tuple(name for name in ALARMS if name not in alarms)
        self.root = f"{base_topic}/{device}"
        self.commands: tuple[str, ...] = ()
        self._home = home_assistant or HomeAssistantSettings()
        check_names(self._home)
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

    def must_deliver(self, before: Snapshot | None, snapshot: Snapshot) -> list[Message]:
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
        """Return those other messages of a snapshot that the broker does not have yet.

        Args:
            sent: State that the broker has.
            snapshot: The snapshot.
            now_s: Monotonic clock [s].

        Returns:
            The messages, and the state that the broker has after them.
        """
        _, parameters, health, info, alarms = snapshot
        before, messages = sent.snapshot, []
        has_sample = bool(parameters.elements)
        if has_sample and (before is None or before.parameters is not parameters):
            messages.append(self._live("parameters", parameters.json_bytes))
        if before is None or before.health.sensor_online != health.sensor_online:
            messages.append(self._sensor(health))
        if before is None or before.health is not health:
            messages.append(self._retained("health", health.json_bytes))
        if before is None or before.info != info:
            messages.append(self._retained("info", info.json_bytes))
        described = self._described(sent, snapshot)
        if described != sent.described:
            payload = self._discovery(described)
            if sent.described is None or payload != self._discovery(sent.described):
                messages.append(Message(discovery_topic(self._home, self._device), payload, 1, retain=True))
        published = {alarm.name: alarm for alarm in before.alarms} if before else {}
        messages += [self._retained(f"alarm/{a.name}", a.json_bytes) for a in alarms if a != published.get(a.name)]
        values, shown = self._home_assistant(sent.shown, snapshot, described, now_s)
        return messages + values, PublishedState(snapshot, shown, described)

    def _described(self, sent: PublishedState, snapshot: Snapshot) -> DiscoveryInputs:
        """Return the discovery data of a snapshot. The number of cells never decreases."""
        cells = len((snapshot.estimate and snapshot.estimate.cells_v) or ())
        known_cells = sent.described.cells if sent.described else 0
        alarms = tuple(alarm.name for alarm in snapshot.alarms)
        return DiscoveryInputs(snapshot.info, max(cells, known_cells), alarms, self.commands, self._unwatched)

    def _home_assistant(
        self, before: EntityStates, snapshot: Snapshot, described: DiscoveryInputs, now_s: float
    ) -> tuple[list[Message], EntityStates]:
        if not self._home.enabled:
            return [], before
        sign = 1.0 if self._home.current_sign == "discharge_positive" else -1.0
        shown = values_to_publish(before, snapshot, described, now_s, sign=sign)
        return ([] if shown is before else [self._live(VALUES, _json(shown.values))]), shown

    def _sensor(self, health: Health) -> Message:
        return self._retained(SENSOR_AVAILABILITY, b"online" if health.sensor_online else b"offline")

    def _discovery(self, described: DiscoveryInputs) -> bytes:
        """Return the discovery payload. It is empty, which removes the device, if discovery is disabled."""
        return _json(discovery(self._home, described, self.root, self._sample_period_s)) if self._home.enabled else b""

    def _queued(self, topic: str, report: Payload) -> Message:
        return Message(f"{self.root}/{topic}", report.json_bytes, 1, retain=False)

    def _live(self, topic: str, payload: bytes) -> Message:
        return Message(f"{self.root}/{topic}", payload, 0, retain=False)

    def _retained(self, topic: str, payload: bytes) -> Message:
        return Message(f"{self.root}/{topic}", payload, 1, retain=True)


@cache
def _schema() -> bytes:
    """Return the schema, which is equal for all packs."""
    return _json(schema())


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
