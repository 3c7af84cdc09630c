"""The newest payload of each topic of each pack. No connection, no clock of its own."""

import json
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from bms_estimator.page.newest import Newest
from bms_estimator.sinks.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.store.minute import epoch_s

STATE, PARAMETERS, RECENT, ELEMENTS = "state", "parameters", "recent", "elements"
"""Topics of the estimate and of the parameters, and what there is here beside the topics of MQTT."""
SHOWN = frozenset({STATE, PARAMETERS, "health", "info", "event", AVAILABILITY, SENSOR_AVAILABILITY})
ALARM = "alarm/"
ELEMENTS_OVER_SOC = frozenset({"r_s_ohm", "r_ts_ohm", "c_ts_farad", "r_tl_ohm", "c_tl_farad"})
RECENT_STATES = 600
RECENT_STEP_S = 1.0
"""Between the states that are kept for the curves of whoever opens the page later [s]."""
RECENT_FIELDS = ("voltage_v", "voltage_estimate_v", "current_a", "power_w", "soc", "soc_std", "innovation_v")

_Row = tuple[float, tuple[float | None, ...]]
"""Seconds since 1970, and what ``RECENT_FIELDS`` were."""


class Hub(Newest):
    """What is known of all packs.

    Keys are ``<pack>/<topic>``, values JSON as text in one line.
    """

    def __init__(self) -> None:
        super().__init__()
        self._topics: dict[str, dict[str, str]] = {}
        self._recent: dict[str, deque[_Row]] = {}
        self._learned: dict[str, dict[str, dict[int, tuple[float, float]]]] = {}

    @property
    def packs(self) -> list[str]:
        """Names of the packs, as they came."""
        return list(self._topics)

    def put(self, pack: str, topic: str, value: Any) -> None:
        """Take what a pack publishes, of the topics that are shown.

        Args:
            pack: Its name.
            topic: Below the pack's.
            value: The payload as JSON has it, or text; None: the topic was emptied.
        """
        if topic not in SHOWN and not topic.startswith(ALARM):
            return
        try:
            text = _json(value)
        except RecursionError:  # somebody else's: deeper than it could be written
            return
        topics = self._topics.setdefault(pack, {})
        if value is None:
            self._forget(pack, topic)
        else:
            topics[topic] = text
        if topic == STATE and isinstance(value, dict):
            self._remember(pack, value)
        if topic == PARAMETERS and isinstance(value, dict):
            self._learn(pack, value)
        self.hand_on(f"{pack}/{topic}", text)

    def known(self) -> dict[str, str]:
        """What a new reader finds."""
        known = super().known()
        for pack, topics in self._topics.items():
            known |= {f"{pack}/{topic}": text for topic, text in topics.items()}
            known[f"{pack}/{RECENT}"] = _json(_columns(self._recent.get(pack, ())))
            known[f"{pack}/{ELEMENTS}"] = _json(self._learned.get(pack, {}))
        return known

    def _forget(self, pack: str, topic: str) -> None:
        """A topic was emptied; with its last one a pack is gone."""
        topics = self._topics[pack]
        topics.pop(topic, None)
        if not topics:
            for of_packs in (self._topics, self._recent, self._learned):
                of_packs.pop(pack, None)

    def _remember(self, pack: str, state: Mapping[str, Any]) -> None:
        """Keep what the curves show, once a second; a state that comes late is left out."""
        try:
            row = epoch_s(state["time"]), tuple(_number(state.get(field)) for field in RECENT_FIELDS)
        except (TypeError, ValueError, KeyError):  # somebody else's
            return
        rows = self._recent.setdefault(pack, deque(maxlen=RECENT_STATES))
        if not rows or row[0] >= rows[-1][0] + RECENT_STEP_S:
            rows.append(row)

    def _learn(self, pack: str, report: Mapping[str, Any]) -> None:
        """Keep what an element was, with its standard deviation, at each percent of SOC."""
        soc, elements = _number(report.get("soc")), report.get("elements")
        if soc is None or not 0.0 <= soc <= 1.0 or not isinstance(elements, dict):
            return
        for name in ELEMENTS_OVER_SOC & elements.keys():
            of = elements[name] if isinstance(elements[name], dict) else {}
            value, std = _number(of.get("value")), _number(of.get("std"))
            if of.get("valid") is True and value is not None and std is not None:
                self._learned.setdefault(pack, {}).setdefault(name, {})[round(100.0 * soc)] = value, std


def _columns(rows: Iterable[_Row]) -> dict[str, list[float | None]]:
    """By name."""
    found: dict[str, list[float | None]] = {"time_s": [time_s for time_s, _ in rows]}
    return found | {field: [values[i] for _, values in rows] for i, field in enumerate(RECENT_FIELDS)}


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _number(value: Any) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
