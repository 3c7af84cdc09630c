"""Builder of MQTT messages from a snapshot and the state already published. It has neither a connection nor a clock.

A value for Home Assistant is published if it has changed enough and its minimum interval has passed. Home Assistant's
recorder writes a row for each published value. Therefore the number of values a minute is limited. If more entities
change, those published longest ago come first.
"""

import json
import math
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from bms_estimator.model.events import events
from bms_estimator.model.payloads.health import Health, Payload
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.model.quantity import Entity
from bms_estimator.mqtt.connection import Message
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.connections import HomeAssistantSettings
from bms_estimator.sinks.home_assistant.discovery import (
    VALUES,
    DiscoveryInputs,
    cell_key,
    check_names,
    discovery,
    discovery_topic,
    entities,
)
from bms_estimator.sinks.mqtt.topics import schema
from bms_estimator.sinks.mqtt.venus_os import venus_battery

MAX_ROWS_PER_MINUTE = 18
"""Maximum number of published values of default-enabled entities in a minute. With two values of alarms, the recorder
writes at most 20 rows a minute."""
MINUTE_S = 60.0
"""Length of the window for ``MAX_ROWS_PER_MINUTE`` [s]."""
MESSAGE_INTERVAL_S = 5.0
"""Minimum interval between two messages with values [s]."""
JOINT = ("voltage_v", "current_a", "power_w")
"""Values of one moment, which are published together."""
UNCERTAIN = (
    *("soc_percent", "remaining_capacity_ah", "remaining_energy_wh", "usable_capacity_ah"),
    *("usable_capacity_to_weakest_ah", "weakest_cell_soc", "time_to_full_h", "cutoff_within_15min_percent"),
    *("time_to_cutoff_h", "time_to_cutoff_p05_h", "time_to_cutoff_p95_h"),
)
"""Values that are unknown while the SOC is not known."""
HEARTBEAT_S = 10.0
"""Interval at which unchanged values are repeated, so that they do not expire [s]."""


class EntityStates(NamedTuple):
    """Values published to Home Assistant, by key of the entity. Times are on a monotonic clock [s]."""

    values: Mapping[str, float | None] = {}
    changed_s: Mapping[str, float] = {}
    """Time at which each value was published."""
    published_s: float = -math.inf
    """Time of the last message."""
    rows_s: tuple[float, ...] = ()
    """Publish time of each value that was counted against ``MAX_ROWS_PER_MINUTE`` in the last minute."""


def values_to_publish(
    published: EntityStates, snapshot: Snapshot, discovery: DiscoveryInputs, now_s: float, *, sign: float = 1.0
) -> EntityStates:
    """Return the values to publish; ``published`` itself if nothing changed enough.

    Args:
        published: Values published last.
        snapshot: Snapshot with the current values.
        discovery: Data that determine the entities.
        now_s: Monotonic clock [s].
        sign: Factor of signed values; -1 if charging is positive.
    """
    elapsed_s = now_s - published.published_s
    if snapshot.estimate is None or elapsed_s < MESSAGE_INTERVAL_S:
        return published
    entities_by_key = entities(discovery.info, discovery.cells)
    values = _round_values(snapshot, entities_by_key, sign)
    due = {key for key, value in values.items() if _is_due(published, key, value, entities_by_key[key], now_s)}
    changed = {key: value for key, value in values.items() if key in due or (key in JOINT and due & {*JOINT})}
    recent_s = tuple(at_s for at_s in published.rows_s if now_s - at_s < MINUTE_S)
    # first values are not limited, because all entities get one at once
    rows = [key for key in changed if entities_by_key[key].enabled and key in published.values]
    rows.sort(key=lambda key: published.changed_s[key])
    for postponed in rows[MAX_ROWS_PER_MINUTE - len(recent_s) :]:
        for key in JOINT if postponed in JOINT else (postponed,):
            changed.pop(key, None)
    if not changed and elapsed_s < HEARTBEAT_S:
        return published
    return published._replace(
        values={**published.values, **changed},
        changed_s={**published.changed_s, **dict.fromkeys(changed, now_s)},
        published_s=now_s,
        rows_s=(*recent_s, *[now_s for key in rows if key in changed]),
    )


def _round_values(snapshot: Snapshot, entities_by_key: Mapping[str, Entity], sign: float) -> dict[str, float | None]:
    """Return the rounded value of each entity; None without a value."""
    values, rounded = _values(snapshot), dict[str, float | None]()
    for key, entity in entities_by_key.items():
        value = values.get(key)
        if value is not None:
            value *= (sign if entity.signed else 1.0) * entity.factor
        # `or None` makes round() return an integer, `or 0` replaces -0.0
        rounded[key] = None if value is None else round(value, entity.decimals or None) or 0
    return rounded


def _values(snapshot: Snapshot) -> dict[str, float | None]:
    """Return all values of a snapshot by the keys of the entities."""
    estimate, parameters = snapshot.estimate, snapshot.parameters
    assert estimate is not None  # noqa: S101 - for the type checker: the caller has checked it
    health, resistance = parameters.state_of_health.get("capacity"), parameters.elements.get("r_s_ohm")
    values = {
        **vars(estimate),
        **{key: element.value for key, element in parameters.elements.items()},
        "soc_std_percent": _scale(100.0, estimate.soc_std),
        "r_s_mohm": _scale(1e3, resistance.value if resistance else None),
        "time_to_cutoff_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_s),
        "time_to_cutoff_p05_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_p05_s),
        "time_to_cutoff_p95_h": _scale(1.0 / 3600.0, estimate.time_to_cutoff_p95_s),
        "cutoff_within_15min_percent": _scale(100.0, estimate.cutoff_within_15min),
        "time_to_full_h": _scale(1.0 / 3600.0, estimate.time_to_full_s),
        "soh_percent": _scale(100.0, health.value if health and health.valid else None),
        "soh_std_percent": _scale(100.0, health.std if health and health.valid else None),
        **{cell_key(number): volts for number, volts in enumerate(estimate.cells_v or (), start=1)},
    }
    return values if estimate.soc_known or estimate.soc is None else values | dict.fromkeys(UNCERTAIN)


def _scale(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


def _is_due(published: EntityStates, key: str, value: float | None, entity: Entity, now_s: float) -> bool:
    """Return True if a value should be published again."""
    if key not in published.values:
        return True
    published_value, interval_passed = published.values[key], now_s - published.changed_s[key] >= entity.min_interval_s
    if published_value is None:
        return value is not None  # at once, because "unknown" is wrong from now on
    if value is None:
        return interval_passed
    min_change = entity.step if interval_passed else entity.immediate_step
    return round(abs(value - published_value), entity.decimals) >= min_change


AVAILABILITY = "availability"
"""Topic of the service's availability, below the device's topic."""
SENSOR_AVAILABILITY = "sensor/availability"
"""Topic of the sensor's availability, below the device's topic."""
VENUS = "venus"
"""Topic of the battery for Venus OS, below the device's topic."""
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

    def corrections(self, sent: PublishedState) -> list[Message]:
        """Return both availabilities and all alarms, which another client may have overwritten."""
        alarms = sent.snapshot.alarms if sent.snapshot else ()
        sensor = [self._sensor(sent.snapshot.health)] if sent.snapshot else []
        alarm_messages = [self._retained(f"alarm/{alarm.name}", alarm.json_bytes) for alarm in alarms]
        return [self._retained(AVAILABILITY, b"online"), *sensor, *alarm_messages]

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
        names = {alarm.name for alarm in snapshot.alarms}
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
