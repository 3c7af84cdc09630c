"""Assembler of samples from values that arrive on several topics at different times. It does no I/O."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from bms_estimator.protocols.base.reading import sample_json_line
from bms_estimator.settings.sources.mqtt import MqttSource, ValueLocation
from bms_estimator.sources.mqtt.payload_value import (
    CELL_PLACEHOLDER,
    MAX_CELL_NUMBER,
    InvalidValueError,
    MissingError,
    cell_pattern,
    read_cells,
    read_value,
)
from bms_estimator.sources.mqtt.publisher_conflict import MIN_JUMPS, PublisherConflict

REQUIRED_QUANTITIES = ("voltage", "current")
"""Quantities without which there is no sample."""
EXPIRING_QUANTITIES = (*REQUIRED_QUANTITIES, "time")
"""Quantities whose values expire even if the publisher is online and sends only changes."""
MAX_RETAINED = 1000
"""Maximum number of retained messages that wait for the status of the publisher."""
REPEAT_PERIODS = 1.5
"""Time without a message after which the last current is used again if the publisher sends only changes, in sample periods. A
regular message may be half a period late."""
REGULAR_MESSAGES = 10
"""Number of successive messages with a temperature or cell voltage after which a message without it shows that the sensor is
lost. A publisher that sends only a part of its values in each message rarely reaches this number."""
MAX_PROBE_NUMBER = 32
"""Highest number of a temperature probe in a path or topic."""
MAX_STATUS_CHARACTERS = 80
"""Maximum number of characters of the publisher's status that are shown."""


class _TopicBinding(NamedTuple):
    """Topic that carries a quantity."""

    quantity: str
    location: ValueLocation
    path: str
    """Path of the value in a JSON payload; empty for a plain number."""
    topic: str
    """Topic, which may contain ``{cell}``."""
    pattern: re.Pattern[str]
    """Pattern of the topic. Its group, if any, is the number of the cell or probe."""
    location_index: int
    """Index of the location of a temperature in the settings; 0 for other quantities."""


class _StoredValue(NamedTuple):
    """Last value of a quantity, a cell or a probe.

    Attributes:
        value: Value in SI units.
        arrival_s: Arrival time [s].
        expiry_s: Time after which the value is too old for a sample [s].
        messages: Number of successive messages of its topic that had a value.
    """

    value: float
    arrival_s: float
    expiry_s: float
    messages: int


_Key = tuple[str, int, int]
"""Quantity, index of its location, and number of the cell or probe; 1 for a quantity with a single value."""


class SampleAssembler:
    """Assembler of lines, one for each sample, from MQTT messages.

    A sample is complete when voltage and current have arrived. If only one of them arrives within ``settle_s``, the last
    value of the other is used up to ``stale_s``, because some publishers send only changes. The line marks a value that
    an earlier sample has used, because the estimator must not use a voltage twice, or with a current of another time.
    A message that lacks a quantity does not erase its last value, because some publishers send only a part of their values in
    each message. A retained temperature or cell voltage is used while the publisher reports itself online. A retained voltage or
    current is rejected, because its age is unknown, unless the publisher sends only changes.

    Attributes:
        faults: Latest error of each quantity without a value in its last message, by name of the quantity.
        first_faults: First error of each kind, with quantity and topic, by name of its counter.
    """

    def __init__(self, settings: MqttSource) -> None:
        self._settings = settings
        self._bindings = [
            _TopicBinding(
                quantity,
                location,
                settings.substitute(location.path),
                topic,
                cell_pattern(topic),
                index if quantity == "temperature" else 0,
            )
            for index, (quantity, location) in enumerate(settings.locations())
            for topic in settings.topics(location)
        ]
        self._availability_topic = settings.substitute(settings.availability_topic or "")
        self._offline_status = ""  # latest status from the publisher or its last will
        self._is_online = False  # True if the latest status is not offline
        self._retained: dict[str, bytes] = {}  # retained messages that wait for the status, by topic
        self._max_age_s = dict.fromkeys(settings.quantities, settings.slow_max_age_s) | {
            **dict.fromkeys(REQUIRED_QUANTITIES, settings.stale_s),
            "time": settings.settle_s,  # an older time belongs to an earlier sample
        }
        self._values: dict[_Key, _StoredValue] = {}
        self._irregular = set[tuple[str, int]]()  # quantities and indices of locations that a message lacked
        self.faults: dict[str, str] = {}
        self.first_faults: dict[str, str] = {}
        self._unused_arrival_s: dict[str, float] = {}  # arrival times of voltage and current since the last sample
        self._repeat_s = math.inf  # time at which the last current is used again
        self._counters = dict.fromkeys(("retained", "missing", "no_number", "stale", "publisher_errors"), 0)
        self._detectors = {
            (binding.quantity, binding.topic): PublisherConflict(MIN_JUMPS[binding.quantity], settings.interval_s)
            for binding in self._bindings
            if binding.quantity in REQUIRED_QUANTITIES
        }
        self._conflicts: dict[tuple[str, str], str] = {}  # topic and values of each conflict, by quantity and topic

    @property
    def topics(self) -> list[str]:
        """Topic filters to subscribe to.

        A filter that another one covers is omitted, because some brokers would deliver its messages twice.
        """
        topics = [binding.topic for binding in self._bindings] + (
            [self._availability_topic] if self._availability_topic else []
        )
        filters = list(dict.fromkeys(_topic_filter(topic) for topic in topics))
        return [topic for topic in filters if not any(_covers(other, topic) for other in filters if other != topic)]

    @property
    def counters(self) -> Mapping[str, int]:
        """Number of faults since start, by kind.

        ``retained`` counts retained messages, ``missing`` payloads without the quantity, ``no_number`` payloads without
        a number, ``stale`` samples without a recent voltage or current, and ``publisher_errors`` messages on a topic to
        which two publishers write.
        """
        return self._counters

    @property
    def conflict(self) -> str:
        """Topics on which two publishers write, with the two values, as text; empty without a conflict."""
        return "; ".join(self._conflicts.values())

    @property
    def fault(self) -> str | None:
        """Reason why no sample is complete; None if unknown."""
        if self._offline_status:
            return f"the publisher reports {self._offline_status} on {self._availability_topic}"
        errors = [fault for name in REQUIRED_QUANTITIES if (fault := self.faults.get(name))]
        if errors:
            return "; ".join(errors)
        absent = [name for name in REQUIRED_QUANTITIES if (name, 0, 1) not in self._values]
        if len(absent) == len(REQUIRED_QUANTITIES):
            retained = " but retained messages" if self._counters["retained"] else ""
            return f"no message on {self._name_topics(*REQUIRED_QUANTITIES)}{retained}"
        return f"{absent[0]}: no message on {self._name_topics(absent[0])}" if absent else None

    @property
    def silence_reason(self) -> str:
        """Reason why no messages arrive any more, with the setting that may help."""
        return f"no new message on {self._name_topics(*REQUIRED_QUANTITIES)}{self._hint}"

    @property
    def _hint(self) -> str:
        """Hint about the setting for a publisher that sends only changes; empty if it is set."""
        return "" if self._settings.max_silent_s else "; if the publisher sends only changes, set source.max_silent_s"

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until a sample is complete without a further message [s]; None if a message is needed."""
        if not self._unused_arrival_s:
            return max(self._repeat_s - now_s, 0.0) if self._repeat_s < math.inf else None
        return max(min(self._unused_arrival_s.values()) + self._settings.settle_s - now_s, 0.0)

    def add_message(self, topic: str, payload: bytes, now_s: float, *, retained: bool) -> None:
        """Store the values of a message.

        Args:
            topic: Topic of the message.
            payload: Received payload.
            now_s: Monotonic clock [s].
            retained: True for a retained message.
        """
        if topic == self._availability_topic:
            text = payload.decode("utf-8", "replace").strip()
            self._offline_status = text[:MAX_STATUS_CHARACTERS] if "offline" in text.lower() else ""
            self._is_online = bool(text) and not self._offline_status
            if self._is_online:
                waiting, self._retained = self._retained, {}
                for retained_topic, retained_payload in waiting.items():
                    self.add_message(retained_topic, retained_payload, now_s, retained=True)
            return
        bindings = [(binding, match) for binding in self._bindings if (match := binding.pattern.fullmatch(topic))]
        if retained and not self._is_online:
            self._counters["retained"] += bool(bindings)
            if bindings and self._availability_topic and len(self._retained) < MAX_RETAINED:
                self._retained[topic] = payload
            return
        if retained and self._settings.max_silent_s is None:
            bindings = [(binding, match) for binding, match in bindings if binding.quantity not in EXPIRING_QUANTITIES]
        has_conflict = False
        for binding, match in bindings:
            number = int(match[1]) if match.re.groups else None
            try:
                self._store_values(binding, _read_values(binding, payload, number), now_s)
            except InvalidValueError as error:
                location = binding.quantity, binding.location_index
                keys = [key for key in self._values if key[:2] == location and number in (None, key[2])]
                self._set_absent(location, keys, is_null=not isinstance(error, MissingError))
                self._counters[error.counter] += 1
                self.faults[binding.quantity] = f"{binding.quantity}: {topic}: {error}"
                self.first_faults.setdefault(error.counter, self.faults[binding.quantity])
            else:
                self.faults.pop(binding.quantity, None)
                has_conflict |= self._update_conflict(binding, now_s)
        self._counters["publisher_errors"] += has_conflict

    def line(self, now_s: float) -> bytes:
        """Return the line of a complete sample; empty without one."""
        if len(self._unused_arrival_s) < len(REQUIRED_QUANTITIES) and self.wait_s(now_s) != 0.0:
            return b""
        voltage_held, current_held = "voltage" not in self._unused_arrival_s, self._current_is_old()
        self._unused_arrival_s.clear()
        voltage_v, current_a = (self._value(name, now_s) for name in REQUIRED_QUANTITIES)
        if voltage_v is None or current_a is None:
            self._count_stale("current" if current_a is None else "voltage")
            self._repeat_s = math.inf
            return b""
        if self._settings.max_silent_s is not None and not current_held:
            self._repeat_s = now_s + REPEAT_PERIODS * self._settings.interval_s
        return sample_json_line(
            voltage_v,
            current_a,
            temperatures_c=self._probes_c(now_s),
            cells_v=self._cells_v(now_s),
            time_s=self._value("time", now_s),
            voltage_held=voltage_held,
            current_held=current_held,
            soc=math.nan if (percent := self._value("soc", now_s)) is None else percent / 100.0,
            capacity_ah=self._value("capacity", now_s) or math.nan,
        )

    def _current_is_old(self) -> bool:
        """Return True if a new voltage has no current within ``settle_s``."""
        current, voltage_s = self._values.get(("current", 0, 1)), self._unused_arrival_s.get("voltage")
        return current is not None and voltage_s is not None and voltage_s - current.arrival_s > self._settings.settle_s

    def _store_values(self, binding: _TopicBinding, readings: Mapping[int, float], now_s: float) -> None:
        """Store the values of a message by number of the cell or probe. NaN is an absent value."""
        location = binding.quantity, binding.location_index
        nulls = [(*location, number) for number, value in readings.items() if math.isnan(value)]
        if nulls:
            self._set_absent(location, nulls, is_null=True)
        for number, value in readings.items():
            highest = MAX_PROBE_NUMBER if binding.quantity == "temperature" else MAX_CELL_NUMBER
            if 1 <= number <= highest and not math.isnan(value):
                key = (*location, number)
                messages = self._values[key].messages + 1 if key in self._values else 1
                permanent = self._is_online and binding.quantity not in EXPIRING_QUANTITIES
                expiry_s = math.inf if permanent else now_s + self._max_age_s[binding.quantity]
                self._values[key] = _StoredValue(value, now_s, expiry_s, messages)
        if binding.quantity in REQUIRED_QUANTITIES:
            self._unused_arrival_s.setdefault(binding.quantity, now_s)

    def _set_absent(self, location: tuple[str, int], keys: Iterable[_Key], *, is_null: bool) -> None:
        """Let temperatures and cell voltages that a message lacks expire earlier, unless the publisher often omits them.

        Args:
            location: Quantity and index of its location.
            keys: Keys of the values that the message lacks.
            is_null: True if the message has null or another invalid value in their place. Null means that the sensor is lost,
                unless an earlier message lacked the quantity. An absent key means it only after ``REGULAR_MESSAGES``.
        """
        is_loss = is_null and location not in self._irregular
        for key in keys:
            stored = self._values.get(key)
            if stored and location[0] not in REQUIRED_QUANTITIES:
                is_regular = is_loss or stored.messages >= REGULAR_MESSAGES
                limit_s = stored.arrival_s + (self._settings.absent_s if is_regular else math.inf)
                self._values[key] = stored._replace(expiry_s=min(stored.expiry_s, limit_s), messages=0)
        self._irregular.add(location)

    def _update_conflict(self, binding: _TopicBinding, now_s: float) -> bool:
        """Add the latest value of a topic to its conflict detector. Return True if two publishers write to the topic."""
        key = binding.quantity, binding.topic
        detector = self._detectors.get(key)
        if detector is None or not detector.add(self._values[binding.quantity, 0, 1].value, now_s):
            self._conflicts.pop(key, None)
            return False
        self._conflicts[key] = f"{binding.topic}: {binding.quantity} {detector.text}"
        return True

    def _is_fresh(self, stored: _StoredValue, now_s: float) -> bool:
        """Return True unless a value is too old. A value without expiry lasts while the publisher is online."""
        return self._is_online if stored.expiry_s == math.inf else now_s <= stored.expiry_s

    def _count_stale(self, name: str) -> None:
        """Count a sample that lacks voltage or current."""
        self._counters["stale"] += 1
        if (name, 0, 1) in self._values:
            topics = self._name_topics(name)
            self.faults.setdefault(name, f"{name}: no message on {topics} for {self._settings.stale_s:g} s{self._hint}")

    def _value(self, name: str, now_s: float) -> float | None:
        """Return a value unless it is too old."""
        stored = self._values.get((name, 0, 1))
        return stored.value if stored and self._is_fresh(stored, now_s) else None

    def _cells_v(self, now_s: float) -> list[float]:
        """Return the voltages from cell 1 to the last cell with a recent value [V]; NaN for a cell without one."""
        cells = {
            key[2]: each for key, each in self._values.items() if key[0] == "cells" and self._is_fresh(each, now_s)
        }
        return [cells[number].value if number in cells else math.nan for number in range(1, max(cells, default=0) + 1)]

    def _probes_c(self, now_s: float) -> list[float]:
        """Return the recent temperatures of all probes in the order of the locations [C]; NaN for a probe without one."""
        probes = sorted(key for key in self._values if key[0] == "temperature")
        counts = {index: number for _, index, number in probes}  # highest number of a probe by index of the location
        keys = [("temperature", index, i + 1) for index, count in counts.items() for i in range(count)]
        slots = [self._values.get(key) for key in keys]
        return [slot.value if slot and self._is_fresh(slot, now_s) else math.nan for slot in slots]

    def _name_topics(self, *quantities: str) -> str:
        """Return the first topic of each quantity, and the number of the others."""
        topics = [[binding.topic for binding in self._bindings if binding.quantity == name] for name in quantities]
        first = dict.fromkeys(each[0] for each in topics)
        others = len({topic for each in topics for topic in each} - set(first))
        return ", ".join(first) + (f" and {others} other topics" if others else "")


def _read_values(binding: _TopicBinding, payload: bytes, number: int | None) -> Mapping[int, float]:
    """Return the values of a payload by number of the cell or probe; 1 for a quantity with a single value.

    Args:
        binding: Quantity and its location.
        payload: Received payload.
        number: Number of the cell or probe in the topic; None without one.

    Raises:
        InvalidValueError: The payload has no valid value.
    """
    has_numbers = binding.quantity == "cells" or CELL_PLACEHOLDER.search(binding.path)
    if number is None and has_numbers:
        return read_cells(payload, binding.location, binding.path)
    return {1 if number is None else number: read_value(payload, binding.location, binding.path)}


def _topic_filter(topic: str) -> str:
    """Return the topic filter of a topic with ``{cell}``."""
    return "/".join("+" if "{cell}" in level else level for level in topic.split("/"))


def _covers(wide: str, narrow: str) -> bool:
    """Return True if the topic filter ``wide`` matches all topics of the filter ``narrow``."""
    wide_levels, narrow_levels = wide.split("/"), narrow.split("/")
    return len(wide_levels) == len(narrow_levels) and all(
        level in ("+", other) for level, other in zip(wide_levels, narrow_levels, strict=True)
    )
