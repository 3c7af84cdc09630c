"""Assembler of samples from values that arrive on several topics at different times. It does no I/O."""

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.protocols.base.reading import sample_json_line
from bms_estimator.settings.sources.mqtt import MqttSource, ValueLocation
from bms_estimator.sources.mqtt.payload_value import (
    CELL_PLACEHOLDER,
    MAX_CELL_NUMBER,
    InvalidValueError,
    cell_pattern,
    read_cells,
    read_value,
)
from bms_estimator.sources.mqtt.publisher_conflict import MIN_JUMPS, PublisherConflict

REQUIRED_QUANTITIES = ("voltage", "current")
"""Quantities without which there is no sample."""
REPEAT_PERIODS = 1.5
"""Time without a message after which the last current is used again if the publisher sends only changes, in sample periods. A
regular message may be half a period late."""
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
    """Index of the location in the settings."""


class _TimestampedValue(NamedTuple):
    """A value and its arrival time [s]."""

    value: float
    arrival_s: float


class SampleAssembler:
    """Assembler of lines, one for each sample, from MQTT messages.

    A sample is complete when voltage and current have arrived. If only one of them arrives within ``settle_s``, the last
    value of the other is used up to ``stale_s``, because some publishers send only changes. The line marks a value that
    an earlier sample has used, because the estimator must not use a voltage twice, or with a current of another time.
    Retained messages are rejected, because their age is unknown.
    """

    def __init__(self, settings: MqttSource) -> None:
        self._settings = settings
        self._bindings = [
            _TopicBinding(quantity, location, settings.substitute(location.path), topic, cell_pattern(topic), index)
            for index, (quantity, location) in enumerate(settings.locations())
            for topic in settings.topics(location)
        ]
        self._availability_topic = settings.substitute(settings.availability_topic or "")
        self._offline_status = ""  # latest status from the publisher or its last will
        self._values: dict[str, _TimestampedValue] = {}
        self._cells: dict[int, _TimestampedValue] = {}
        self._probes: dict[tuple[int, int], _TimestampedValue] = {}  # by index of the location and number of the probe
        self._faults: dict[str, str] = {}  # latest error of each quantity
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
        errors = [fault for name in REQUIRED_QUANTITIES if (fault := self._faults.get(name))]
        if errors:
            return "; ".join(errors)
        if not self._values:
            retained = " but retained messages" if self._counters["retained"] else ""
            return f"no message on {', '.join(dict.fromkeys(self._find_topics(*REQUIRED_QUANTITIES)))}{retained}"
        absent = [name for name in REQUIRED_QUANTITIES if name not in self._values]
        return f"{absent[0]}: no message on {', '.join(self._find_topics(absent[0]))}" if absent else None

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
            return
        bindings = [(binding, match) for binding in self._bindings if (match := binding.pattern.fullmatch(topic))]
        if retained:
            self._counters["retained"] += bool(bindings)
            return
        has_conflict = False
        for binding, match in bindings:
            cell = int(match[1]) if match.re.groups else None
            try:
                self._store_value(binding, payload, cell, now_s)
            except InvalidValueError as error:
                self._remove(binding, cell)
                self._counters[error.counter] += 1
                self._faults[binding.quantity] = f"{binding.quantity}: {topic}: {error}"
            else:
                self._faults.pop(binding.quantity, None)
                has_conflict |= self._update_conflict(binding, now_s)
        self._counters["publisher_errors"] += has_conflict

    def line(self, now_s: float) -> bytes:
        """Return the line of a complete sample; empty without one."""
        if len(self._unused_arrival_s) < len(REQUIRED_QUANTITIES) and self.wait_s(now_s) != 0.0:
            return b""
        voltage_held, current_held = "voltage" not in self._unused_arrival_s, self._current_is_old()
        self._unused_arrival_s.clear()
        voltage_v, current_a = (self._value(name, now_s, self._settings.stale_s) for name in REQUIRED_QUANTITIES)
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
            time_s=self._value("time", now_s, self._settings.settle_s),  # an older time belongs to an earlier sample
            voltage_held=voltage_held,
            current_held=current_held,
        )

    def _current_is_old(self) -> bool:
        """Return True if a new voltage has no current within ``settle_s``."""
        current, voltage_s = self._values.get("current"), self._unused_arrival_s.get("voltage")
        return current is not None and voltage_s is not None and voltage_s - current.arrival_s > self._settings.settle_s

    def _store_value(self, binding: _TopicBinding, payload: bytes, cell: int | None, now_s: float) -> None:
        """Store the values of a payload.

        Raises:
            InvalidValueError: The payload has no valid value; nothing is stored.
        """
        if binding.quantity == "temperature":
            self._store_probes(binding, payload, cell, now_s)
        elif binding.quantity != "cells":
            self._values[binding.quantity] = _TimestampedValue(
                read_value(payload, binding.location, binding.path), now_s
            )
            if binding.quantity in REQUIRED_QUANTITIES:
                self._unused_arrival_s.setdefault(binding.quantity, now_s)
        elif cell is None:
            self._cells |= {
                number: _TimestampedValue(v, now_s)
                for number, v in read_cells(payload, binding.location, binding.path).items()
            }
        elif 1 <= cell <= MAX_CELL_NUMBER:
            self._cells[cell] = _TimestampedValue(read_value(payload, binding.location, binding.path), now_s)

    def _store_probes(self, binding: _TopicBinding, payload: bytes, probe: int | None, now_s: float) -> None:
        """Store the temperatures of a payload, as ``_store_value``. A location without ``{probe}`` has one probe."""
        if probe is None and CELL_PLACEHOLDER.search(binding.path):
            readings_c = read_cells(payload, binding.location, binding.path)
        else:
            readings_c = {1 if probe is None else probe: read_value(payload, binding.location, binding.path)}
        self._probes |= {
            (binding.location_index, number): _TimestampedValue(reading_c, now_s)
            for number, reading_c in readings_c.items()
            if 1 <= number <= MAX_PROBE_NUMBER
        }

    def _remove(self, binding: _TopicBinding, cell: int | None) -> None:
        """Remove the stored value of a quantity.

        For ``cells`` and ``temperature``, remove the value of the cell or probe number ``cell``. Without a number, remove the
        values of all cells, or of all probes of the topic.
        """
        quantity = binding.quantity
        for index, number in self._probes:
            if quantity == "temperature" and index == binding.location_index and cell in (None, number):
                self._probes[index, number] = _TimestampedValue(math.nan, -math.inf)
        self._values.pop(quantity, None)
        self._unused_arrival_s.pop(quantity, None)
        if quantity == "cells":
            removed = tuple(self._cells) if cell is None else (cell,)
            for each in removed:
                self._cells.pop(each, None)

    def _update_conflict(self, binding: _TopicBinding, now_s: float) -> bool:
        """Add the latest value of a topic to its conflict detector. Return True if two publishers write to the topic."""
        key = binding.quantity, binding.topic
        detector = self._detectors.get(key)
        if detector is None or not detector.add(self._values[binding.quantity].value, now_s):
            self._conflicts.pop(key, None)
            return False
        self._conflicts[key] = f"{binding.topic}: {binding.quantity} {detector.text}"
        return True

    def _count_stale(self, name: str) -> None:
        """Count a sample that lacks voltage or current."""
        self._counters["stale"] += 1
        if name in self._values:
            topics = ", ".join(self._find_topics(name))
            self._faults.setdefault(name, f"{name}: no message on {topics} for {self._settings.stale_s:g} s")

    def _value(self, name: str, now_s: float, max_age_s: float) -> float | None:
        """Return a value unless it is older than ``max_age_s``."""
        stored = self._values.get(name)
        return stored.value if stored and now_s - stored.arrival_s <= max_age_s else None

    def _cells_v(self, now_s: float) -> list[float]:
        """Return the voltages from cell 1 to the last cell with a recent value [V]; NaN for a cell without one."""
        max_age_s = self._settings.slow_max_age_s
        fresh = {cell: stored.value for cell, stored in self._cells.items() if now_s - stored.arrival_s <= max_age_s}
        return [fresh.get(cell, math.nan) for cell in range(1, max(fresh, default=0) + 1)]

    def _probes_c(self, now_s: float) -> list[float]:
        """Return the recent temperatures of all probes in the order of the locations [C]; NaN for a probe without one."""
        max_age_s = self._settings.slow_max_age_s
        counts = dict(sorted(self._probes))  # highest number of a probe by index of the location
        slots = [self._probes.get((index, i + 1)) for index, count in counts.items() for i in range(count)]
        return [slot.value if slot and now_s - slot.arrival_s <= max_age_s else math.nan for slot in slots]

    def _find_topics(self, *quantities: str) -> list[str]:
        return [binding.topic for binding in self._bindings if binding.quantity in quantities]


def _topic_filter(topic: str) -> str:
    """Return the topic filter of a topic with ``{cell}``."""
    return "/".join("+" if "{cell}" in level else level for level in topic.split("/"))


def _covers(wide: str, narrow: str) -> bool:
    """Return True if the topic filter ``wide`` matches all topics of the filter ``narrow``."""
    wide_levels, narrow_levels = wide.split("/"), narrow.split("/")
    return len(wide_levels) == len(narrow_levels) and all(
        level in ("+", other) for level, other in zip(wide_levels, narrow_levels, strict=True)
    )
