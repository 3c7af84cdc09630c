"""Assembly of one sample from several topics with their own times. Pure: the time is an argument."""

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from bms_estimator.protocols.base.reading import sample_json_line
from bms_estimator.settings.mqtt_source import MqttSource, ValueLocation
from bms_estimator.sources.mqtt.payload_value import MAX_CELLS, InvalidValueError, cell_pattern, read_cells, read_value
from bms_estimator.sources.mqtt.publisher_conflict import MIN_JUMPS, PublisherConflict

NEEDED = ("voltage", "current")


class _TopicBinding(NamedTuple):
    """A topic of a quantity."""

    quantity: str
    place: ValueLocation
    path: str
    topic: str
    pattern: re.Pattern[str]
    """Pattern of the topic; with a group for the cell's number, if it has one."""


class _TimestampedValue(NamedTuple):
    """A value and its arrival time [s]."""

    value: float
    at_s: float


class SampleAssembler:
    """Takes messages, gives lines.

    A sample is complete when voltage and current have arrived, or one of them has and the other has not within
    ``settle_s``: some publishers send only changes. That one counts for ``max_age_s``.
    Retained messages are rejected, because their age is unknown.
    """

    def __init__(self, settings: MqttSource) -> None:
        self._settings = settings
        self._ways = [
            _TopicBinding(quantity, place, settings.substitute(place.path), topic, cell_pattern(topic))
            for quantity, place in settings.places()
            for topic in settings.topics(place)
        ]
        self._availability = settings.substitute(settings.availability_topic or "")
        self._offline = ""  # latest status from the publisher or its last will
        self._told: dict[str, _TimestampedValue] = {}
        self._cells: dict[int, _TimestampedValue] = {}
        self._faults: dict[str, str] = {}  # latest error of each quantity
        self._new: dict[str, float] = {}  # voltage and current received since the last sample, with their times
        self._counters = dict.fromkeys(("retained", "missing", "no_number", "stale", "publisher_errors"), 0)
        self._detectors = {
            (way.quantity, way.topic): PublisherConflict(MIN_JUMPS[way.quantity], settings.interval_s)
            for way in self._ways
            if way.quantity in NEEDED
        }
        self._conflicts: dict[tuple[str, str], str] = {}  # by quantity and topic

    @property
    def topics(self) -> list[str]:
        """Return the topics to subscribe to without those that another one covers, which some brokers would deliver twice."""
        topics = [way.topic for way in self._ways] + ([self._availability] if self._availability else [])
        filters = list(dict.fromkeys(_filter(topic) for topic in topics))
        return [topic for topic in filters if not any(_covers(other, topic) for other in filters if other != topic)]

    @property
    def counters(self) -> Mapping[str, int]:
        """Retained messages, payloads without the quantity or without a number; samples that lacked one of two.

        ``publisher_errors`` counts messages on a topic while two publishers write there.
        """
        return self._counters

    @property
    def conflict(self) -> str:
        """Topics on which two publishers write, with the two values, as text for people; empty without a conflict."""
        return "; ".join(self._conflicts.values())

    @property
    def fault(self) -> str | None:
        """Reason why no sample is complete; None if unknown."""
        if self._offline:
            return f"the publisher says {self._offline} on {self._availability}"
        wrong = [fault for name in NEEDED if (fault := self._faults.get(name))]
        if wrong:
            return "; ".join(wrong)
        if not self._told:
            kept = ", but what the broker has kept from earlier" if self._counters["retained"] else ""
            return f"nothing comes on {', '.join(dict.fromkeys(self._topics_of(*NEEDED)))}{kept}"
        absent = [name for name in NEEDED if name not in self._told]
        return f"{absent[0]}: nothing comes on {', '.join(self._topics_of(absent[0]))}" if absent else None

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until a sample is complete without another message [s]; None if it needs one."""
        return max(min(self._new.values()) + self._settings.settle_s - now_s, 0.0) if self._new else None

    def take(self, topic: str, payload: bytes, now_s: float, *, retained: bool) -> None:
        """Take a message.

        Args:
            topic: Topic of the message.
            payload: Received payload.
            now_s: Monotonic clock [s].
            retained: True for a retained message.
        """
        if topic == self._availability:
            text = payload.decode("utf-8", "replace").strip()
            self._offline = text[:80] if "offline" in text.lower() else ""
            return
        ways = [(way, match) for way in self._ways if (match := way.pattern.fullmatch(topic))]
        if retained:
            self._counters["retained"] += bool(ways)
            return
        conflict = False
        for way, match in ways:
            cell = int(match[1]) if match.re.groups else None
            try:
                self._put(way, payload, cell, now_s)
            except InvalidValueError as error:
                self._drop(way.quantity, cell)
                self._counters[error.kind] += 1
                self._faults[way.quantity] = f"{way.quantity}: {topic}: {error}"
            else:
                self._faults.pop(way.quantity, None)
                conflict |= self._has_conflict(way, now_s)
        self._counters["publisher_errors"] += conflict

    def line(self, now_s: float) -> bytes:
        """Return the line of a complete sample; None without one."""
        if not self._new or (len(self._new) < len(NEEDED) and (self.wait_s(now_s) or 0.0) > 0.0):
            return b""
        self._new.clear()
        voltage_v, current_a = (self._value(name, now_s, self._settings.max_age_s) for name in NEEDED)
        if voltage_v is None or current_a is None:
            self._miss("current" if current_a is None else "voltage")
            return b""
        return sample_json_line(
            voltage_v,
            current_a,
            temperature_c=self._value("temperature", now_s, self._settings.slow_max_age_s),
            cells_v=self._cells_v(now_s),
            time_s=self._value("time", now_s, self._settings.settle_s),
        )

    def _put(self, way: _TopicBinding, payload: bytes, cell: int | None, now_s: float) -> None:
        """Store the values of a payload.

        Raises:
            InvalidValueError: Nothing.
        """
        if way.quantity != "cells":
            self._told[way.quantity] = _TimestampedValue(read_value(payload, way.place, way.path), now_s)
            if way.quantity in NEEDED:
                self._new.setdefault(way.quantity, now_s)
        elif cell is None:
            self._cells |= {
                number: _TimestampedValue(v, now_s) for number, v in read_cells(payload, way.place, way.path).items()
            }
        elif 1 <= cell <= MAX_CELLS:
            self._cells[cell] = _TimestampedValue(read_value(payload, way.place, way.path), now_s)

    def _drop(self, quantity: str, cell: int | None) -> None:
        """Forget a quantity that is no longer measured; ``cell`` None: all cells."""
        self._told.pop(quantity, None)
        self._new.pop(quantity, None)
        if quantity == "cells":
            gone = tuple(self._cells) if cell is None else (cell,)
            for each in gone:
                self._cells.pop(each, None)

    def _has_conflict(self, way: _TopicBinding, now_s: float) -> bool:
        """Return whether two publishers write the latest value on this topic."""
        key = way.quantity, way.topic
        detector = self._detectors.get(key)
        if detector is None or not detector.take(self._told[way.quantity].value, now_s):
            self._conflicts.pop(key, None)
            return False
        self._conflicts[key] = f"{way.topic}: {way.quantity} {detector.text}"
        return True

    def _miss(self, name: str) -> None:
        """Count a sample that lacks voltage or current."""
        self._counters["stale"] += 1
        if name in self._told:
            topics = ", ".join(self._topics_of(name))
            self._faults.setdefault(name, f"{name}: nothing on {topics} for {self._settings.max_age_s:g} s")

    def _value(self, name: str, now_s: float, most_s: float) -> float | None:
        """Return a value unless it is older than ``most_s``."""
        told = self._told.get(name)
        return told.value if told and now_s - told.at_s <= most_s else None

    def _cells_v(self, now_s: float) -> list[float]:
        """Return the cells from the first to the last recent one; NaN for those in between without a recent value."""
        most_s = self._settings.slow_max_age_s
        fresh = {cell: told.value for cell, told in self._cells.items() if now_s - told.at_s <= most_s}
        return [fresh.get(cell, math.nan) for cell in range(1, max(fresh, default=0) + 1)]

    def _topics_of(self, *quantities: str) -> list[str]:
        return [way.topic for way in self._ways if way.quantity in quantities]


def _filter(topic: str) -> str:
    """Return the topic filter of a topic with ``{cell}``."""
    return "/".join("+" if "{cell}" in level else level for level in topic.split("/"))


def _covers(one: str, other: str) -> bool:
    """Return True if the first topic filter covers the second."""
    levels, others = one.split("/"), other.split("/")
    return len(levels) == len(others) and all(a in ("+", b) for a, b in zip(levels, others, strict=True))
