"""Newest payload of each topic of each pack. No I/O."""

import json
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from bms_estimator.model.payloads.health import Payload
from bms_estimator.page.event_stream import LatestValues
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.store.history import epoch_s

PACKS = "packs"
"""Key of the names of all packs and of the number of hidden packs, which are more than the page can show."""
STATE, PARAMETERS, EVENT, RECENT, ELEMENTS = "state", "parameters", "event", "recent", "elements"
"""Topics of state, parameters and events, and two keys that exist only here: recent states, and elements over SOC."""
SHOWN_TOPICS = frozenset(
    {STATE, PARAMETERS, "forecast", "health", "cells", "info", EVENT, AVAILABILITY, SENSOR_AVAILABILITY}
)
ALARM = "alarm/"
"""Prefix of the topics of alarms."""
ELEMENTS_OVER_SOC = frozenset({"r_s_ohm", "r_ts_ohm", "c_ts_farad", "r_tl_ohm", "c_tl_farad"})
RECENT_STATES = 600
"""Maximum number of stored states of a pack."""
RECENT_EVENTS = 50
"""Maximum number of stored events of a pack, as many as the page lists."""
MAX_EVENT_CHARACTERS = 4096
"""Maximum length of a stored event [characters]. Only events of other publishers are longer."""
RECENT_STEP_S = 1.0
"""Minimum interval of the states that are stored for the curves of a new reader [s]."""
MAX_LEAD_S = 86_400.0
"""Maximum lead of a state's time over the wall clock [s]. A state with a larger lead is ignored."""
MAX_STORED_LEAD_S = 60.0
"""A stored state that leads the wall clock and the next state by more than this [s] is removed: its clock was wrong."""
RECENT_FIELDS = ("voltage_v", "voltage_estimate_v", "current_a", "power_w", "soc", "soc_std", "innovation_v")

_STORED_FIELDS = {STATE: {"time", *RECENT_FIELDS}, PARAMETERS: {"soc", "elements"}}
"""Fields of the topics that are stored for the curves."""

_Row = tuple[float, tuple[float | None, ...]]
"""Time [s since 1970] and values of ``RECENT_FIELDS``."""


class PackTopics(LatestValues):
    """Latest payloads of all packs, as JSON text in one line, by ``<pack>/<topic>``. The text of ``event`` lists the last events.

    Args:
        wall: Wall clock, seconds since 1970.
    """

    def __init__(self, wall: Callable[[], float] = time.time) -> None:
        super().__init__()
        self._wall, self._hidden = wall, 0
        self._topics: dict[str, dict[str, str]] = {}
        self._recent: dict[str, deque[_Row]] = {}
        self._elements: dict[str, dict[str, dict[int, tuple[float, float]]]] = {}
        self._events: dict[str, deque[str]] = {}

    @property
    def packs(self) -> list[str]:
        """Names of the packs, in the order of their first message."""
        return list(self._topics)

    def put(self, pack: str, topic: str, value: Any) -> None:
        """Store a payload, unless the page does not show its topic.

        Args:
            pack: Name of the pack.
            topic: Topic relative to that of the pack.
            value: A ``Payload``, parsed JSON or text; None: the topic was cleared.
        """
        if topic not in SHOWN_TOPICS and not topic.startswith(ALARM):
            return
        try:
            text = value.json_bytes.decode() if isinstance(value, Payload) else _json(value)
        except RecursionError:  # nested too deeply, from another publisher
            return
        if isinstance(value, Payload):
            value = value.model_dump(include=_STORED_FIELDS.get(topic, set()))
        if topic == EVENT and value is not None:
            events = self._events.setdefault(pack, deque(maxlen=RECENT_EVENTS))
            if len(text) <= MAX_EVENT_CHARACTERS:
                events.append(text)
            text = f"[{','.join(events)}]"
        if value is None:
            self._remove_topic(pack, topic)
        else:
            self._add(pack)[topic] = text
        if topic == STATE and isinstance(value, dict):
            self._store_state(pack, value)
        if topic == PARAMETERS and isinstance(value, dict):
            self._store_elements(pack, value)
        self.broadcast(f"{pack}/{topic}")

    def drop(self, pack: str) -> None:
        """Remove a pack."""
        if self._topics.pop(pack, None) is None:
            return
        self._recent.pop(pack, None)
        self._elements.pop(pack, None)
        self._events.pop(pack, None)
        self._publish_packs()

    def set_hidden_count(self, count: int) -> None:
        """Set the number of packs that are not shown, and send it to the readers."""
        if count != self._hidden:
            self._hidden = count
            self._publish_packs()

    def keys(self) -> list[str]:
        """Return the keys whose texts a new reader receives."""
        keys = super().keys()
        for pack, topics in self._topics.items():
            keys += [f"{pack}/{topic}" for topic in (*topics, RECENT, ELEMENTS)]
        return keys

    def text(self, key: str) -> str | None:
        """Return the newest text of a key; None: its pack is gone."""
        pack, slash, topic = key.partition("/")
        if not slash:
            return super().text(key)
        if pack not in self._topics:
            return None
        if topic == RECENT:
            return _json(_columns(self._recent.get(pack, ())))
        if topic == ELEMENTS:
            return _json(self._elements.get(pack, {}))
        return self._topics[pack].get(topic, "null")

    def _add(self, pack: str) -> dict[str, str]:
        """Return the topics of a pack, which is added if it is new."""
        if pack not in self._topics:
            self._topics[pack] = {}
            self._publish_packs()
        return self._topics[pack]

    def _remove_topic(self, pack: str, topic: str) -> None:
        """Remove a topic, and the pack with its last one."""
        topics = self._topics.get(pack, {})
        topics.pop(topic, None)
        if not topics:
            self.drop(pack)

    def _publish_packs(self) -> None:
        self.set_value(PACKS, _json({"names": self.packs, "hidden": self._hidden}))

    def _store_state(self, pack: str, state: Mapping[str, Any]) -> None:
        """Store a state for the curves, at most once a second. A late state, or one far in the future, is ignored."""
        try:
            time_s, values = epoch_s(state["time"]), tuple(_number(state.get(field)) for field in RECENT_FIELDS)
        except (TypeError, ValueError, KeyError):  # invalid, from another publisher
            return
        if time_s > self._wall() + MAX_LEAD_S:  # it would hide all later states
            return
        rows = self._recent.setdefault(pack, deque(maxlen=RECENT_STATES))
        while rows and rows[-1][0] > max(time_s, self._wall()) + MAX_STORED_LEAD_S:
            rows.pop()
        if not rows or time_s >= rows[-1][0] + RECENT_STEP_S:
            rows.append((time_s, values))

    def _store_elements(self, pack: str, report: Mapping[str, Any]) -> None:
        """Store the last value and standard deviation of each element, by percent of SOC."""
        soc, elements = _number(report.get("soc")), report.get("elements")
        if soc is None or not 0.0 <= soc <= 1.0 or not isinstance(elements, dict):
            return
        for name in ELEMENTS_OVER_SOC & elements.keys():
            element = elements[name] if isinstance(elements[name], dict) else {}
            value, std = _number(element.get("value")), _number(element.get("std"))
            if element.get("valid") is True and value is not None and std is not None:
                self._elements.setdefault(pack, {}).setdefault(name, {})[round(100.0 * soc)] = value, std


def _columns(rows: Iterable[_Row]) -> dict[str, list[float | None]]:
    """Return the columns by name."""
    times: dict[str, list[float | None]] = {"time_s": [time_s for time_s, _ in rows]}
    return times | {field: [values[i] for _, values in rows] for i, field in enumerate(RECENT_FIELDS)}


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _number(value: Any) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
