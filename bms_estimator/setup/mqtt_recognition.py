"""Recognition of battery publishers in MQTT messages by the topics of the known profiles. It does no I/O."""

import functools
import itertools
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from bms_estimator.model.cell_slots import is_live
from bms_estimator.settings.sources.mqtt import MqttSource, ValueLocation
from bms_estimator.settings.sources.mqtt_profiles import DISCHARGE, PROFILES, ProfileName
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.found_device import NAME_SEPARATOR, FoundDevice, values_text
from bms_estimator.sources.mqtt.payload_value import InvalidValueError, read_cells, read_value

MAX_PUBLISHERS = 1000
"""Maximum number of publishers that are stored. Messages of further publishers are ignored."""
MAX_SILENT_S = 300.0
"""Setting ``source.max_silent_s`` of a publisher that sends only changes [s]."""
_PLACEHOLDER = re.compile(r"\{(prefix|instance|cell|probe)\}")
_PATTERNS = {"prefix": ".+", "instance": "[^/]*", "cell": "[0-9]{1,3}", "probe": "[0-9]{1,3}"}
"""Pattern of the text that replaces a placeholder of a topic."""


class Publisher(NamedTuple):
    """Battery in the topics of a profile."""

    profile: ProfileName
    prefix: str
    instance: str


class _Template(NamedTuple):
    """Topic of a quantity in a profile."""

    profile: ProfileName
    quantity: str
    location: ValueLocation
    pattern: re.Pattern[str]


class PublisherRecognition:
    """Collection of the values that publishers of known profiles send."""

    def __init__(self) -> None:
        self._values: dict[Publisher, dict[str, float]] = {}
        self._topics: dict[Publisher, str] = {}  # topic of the voltage
        self._live: dict[Publisher, dict[str, list[bytes]]] = {}  # live payloads by name of the value
        self._retained: dict[Publisher, set[str]] = {}  # names of the retained values

    def add_message(self, topic: str, payload: bytes, *, retained: bool = False) -> None:
        """Store the values that the profiles with this topic read from the message."""
        recognized = set[tuple[ProfileName, str]]()
        for template in _templates():
            key = (template.profile, template.quantity)
            match = template.pattern.fullmatch(topic)
            if match is None or key in recognized:
                continue
            publisher = _publisher(template.profile, match.groupdict())
            if publisher not in self._values and len(self._values) >= MAX_PUBLISHERS:
                continue
            values = _values(template, publisher, topic, payload)
            if values:
                recognized.add(key)
                self._values.setdefault(publisher, {}).update(values)
                if template.quantity == "voltage":
                    self._topics[publisher] = topic
                if retained:
                    self._retained.setdefault(publisher, set()).update(values)
                    continue
                for name in values:
                    self._live.setdefault(publisher, {}).setdefault(name, []).append(payload)

    def devices(self, broker: BrokerLogin) -> list[FoundDevice]:
        """Return the publishers of voltage and current, those with the most values first.

        A topic may be part of several profiles. For each voltage topic the publisher with the most values is returned;
        publishers with equally many values are all returned.

        Args:
            broker: Broker that sent the messages.
        """
        complete = {p: values for p, values in self._values.items() if {"voltage", "current"} <= values.keys()}
        value_counts = dict[str, int]()  # number of values of the best publisher, by voltage topic
        for publisher, values in complete.items():
            topic = self._topics[publisher]
            value_counts[topic] = max(value_counts.get(topic, 0), len(values))
        best = [p for p, values in complete.items() if len(values) == value_counts[self._topics[p]]]
        best.sort(key=lambda p: (-len(complete[p]), p))
        return [_device(p, complete[p], broker, only_changes=self._sends_only_changes(p)) for p in best]

    def _sends_only_changes(self, publisher: Publisher) -> bool:
        """Return True if a retained voltage, current or cell voltage stayed silent, and no live value was repeated.

        A silent temperature, SOC or capacity is no sign, because some publishers send these less often than the other values.
        """
        live = self._live.get(publisher, {})
        repeated = any(a == b for payloads in live.values() for a, b in itertools.pairwise(payloads))
        silent = self._retained.get(publisher, set()) - live.keys() - {"temperature", "soc", "capacity"}
        return bool(silent) and not repeated


@functools.cache
def _templates() -> tuple[_Template, ...]:
    return tuple(_iter_templates())


def _iter_templates() -> Iterator[_Template]:
    for name, profile in PROFILES.items():
        for quantity in ("voltage", "current", "temperature", "cells", "soc", "capacity"):
            if quantity not in profile.table:
                continue
            tables = profile.table[quantity]
            for table in tables if isinstance(tables, list) else [tables]:
                location = ValueLocation.model_validate(table)
                for topic in location.topics:
                    yield _Template(name, quantity, location, _topic_pattern(topic))


def _topic_pattern(topic: str) -> re.Pattern[str]:
    """Return the pattern of a topic; its groups are the placeholders."""
    pattern, end, seen = "", 0, set[str]()
    for match in _PLACEHOLDER.finditer(topic):
        name = match[1]
        pattern += re.escape(topic[end : match.start()])
        pattern += f"(?P={name})" if name in seen else f"(?P<{name}>{_PATTERNS[name]})"
        seen.add(name)
        end = match.end()
    return re.compile(pattern + re.escape(topic[end:]))


def _publisher(profile: ProfileName, groups: Mapping[str, str]) -> Publisher:
    table = PROFILES[profile].table
    return Publisher(profile, groups.get("prefix", ""), groups.get("instance", table.get("instance", "")))


def _values(template: _Template, publisher: Publisher, topic: str, payload: bytes) -> dict[str, float]:
    """Return the valid values of a payload by name: the quantity, or ``cell`` and its number."""
    path = template.location.path.replace("{prefix}", publisher.prefix).replace("{instance}", publisher.instance)
    match = template.pattern.fullmatch(topic)
    try:
        if template.quantity != "cells":
            return {template.quantity: read_value(payload, template.location, path)}
        if match and "cell" in match.groupdict():  # each cell has a topic
            return {f"cell {int(match['cell'])}": read_value(payload, template.location, path)}
        return {f"cell {number}": v for number, v in read_cells(payload, template.location, path).items()}
    except InvalidValueError:
        return {}


def _device(
    publisher: Publisher, values: Mapping[str, float], broker: BrokerLogin, *, only_changes: bool
) -> FoundDevice:
    profile = PROFILES[publisher.profile]
    # values that differ from the defaults of the profile
    address = {
        key: value
        for key, value in {"prefix": publisher.prefix, "instance": publisher.instance}.items()
        if value and value != profile.table.get(key)
    }
    source: dict[str, object] = {"kind": "mqtt", "profile": publisher.profile, **address}
    if only_changes:
        source["max_silent_s"] = MAX_SILENT_S
    sign = 1.0 if profile.current_sign == DISCHARGE else -1.0
    cells = int(is_live(np.array([v for key, v in values.items() if key.startswith("cell ")])).sum())
    return FoundDevice(
        name=NAME_SEPARATOR.join((publisher.profile, *address.values())),
        description=f"{MqttSource.model_validate(source).short_description}, {broker.url}",
        tables={"source": source},
        cells=cells or None,
        voltage_v=values["voltage"],
        soc=values["soc"] / 100.0 if "soc" in values else None,
        capacity_ah=values.get("capacity"),
        values=values_text(values["voltage"], sign * values["current"]),
        broker=broker,
    )
