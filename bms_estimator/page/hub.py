"""The newest payload of each topic of each pack, and who reads them. No connection, no clock of its own.

A reader who is slow finds only the newest of what came meanwhile: what waits for one is at most a payload for each topic.
"""

import asyncio
import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from bms_estimator.sinks.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.store.minute import epoch_s

STATE, PARAMETERS, RECENT, ELEMENTS, LINK = "state", "parameters", "recent", "elements", "link"
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


class Hub:
    """What is known of all packs.

    Keys are ``<pack>/<topic>``, values JSON as text in one line.
    """

    def __init__(self) -> None:
        self._newest: dict[str, dict[str, str]] = {}
        self._recent: dict[str, deque[_Row]] = {}
        self._learned: dict[str, dict[str, dict[int, tuple[float, float]]]] = {}
        self._readers: set[Reader] = set()
        self._link: str | None = None

    @property
    def packs(self) -> list[str]:
        """Names of the packs, as they came."""
        return list(self._newest)

    @property
    def readers(self) -> int:
        """How many read now."""
        return len(self._readers)

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
        topics = self._newest.setdefault(pack, {})
        if value is None:
            self._forget(pack, topic)
        else:
            topics[topic] = text
        if topic == STATE and isinstance(value, dict):
            self._remember(pack, value)
        if topic == PARAMETERS and isinstance(value, dict):
            self._learn(pack, value)
        self._hand_on(f"{pack}/{topic}", text)

    def say_link(self, trouble: str | None) -> None:
        """Whether what fills this hub is connected: why not, or None when it is."""
        text = json.dumps({"up": trouble is None, "reason": trouble})
        if text != self._link:
            self._link = text
            self._hand_on(LINK, text)

    @contextmanager
    def reading(self) -> Iterator["Reader"]:
        """A reader, who finds all that is known first."""
        reader = Reader(self._all())
        self._readers.add(reader)
        try:
            yield reader
        finally:
            self._readers.discard(reader)

    def close(self) -> None:
        """Let all readers end."""
        for reader in self._readers:
            reader.close()

    def _all(self) -> dict[str, str]:
        known = {LINK: self._link} if self._link else {}
        for pack, topics in self._newest.items():
            known |= {f"{pack}/{topic}": text for topic, text in topics.items()}
            known[f"{pack}/{RECENT}"] = _json(_columns(self._recent.get(pack, ())))
            known[f"{pack}/{ELEMENTS}"] = _json(self._learned.get(pack, {}))
        return known

    def _forget(self, pack: str, topic: str) -> None:
        """A topic was emptied; with its last one a pack is gone."""
        topics = self._newest[pack]
        topics.pop(topic, None)
        if not topics:
            for of_packs in (self._newest, self._recent, self._learned):
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

    def _hand_on(self, key: str, text: str) -> None:
        for reader in self._readers:
            reader.put(key, text)


class Reader:
    """What waits for one who reads.

    Args:
        known: What is there at first.
    """

    def __init__(self, known: Mapping[str, str]) -> None:
        self._waiting = dict(known)
        self._due = asyncio.Event()
        self._due.set()
        self.closed = False

    def put(self, key: str, text: str) -> None:
        """Have the newest wait."""
        self._waiting[key] = text
        self._due.set()

    def close(self) -> None:
        """Nothing more will come."""
        self.closed = True
        self._due.set()

    async def next(self, longest_s: float) -> str:
        """All that waits as one JSON object; empty when nothing came in ``longest_s``, or when it is closed."""
        try:
            async with asyncio.timeout(longest_s):
                await self._due.wait()
        except TimeoutError:
            return ""
        self._due.clear()
        waiting, self._waiting = self._waiting, {}
        parts = ",".join(f"{json.dumps(key)}:{text}" for key, text in waiting.items())
        return f"{{{parts}}}" if parts else ""


def _columns(rows: Iterable[_Row]) -> dict[str, list[float | None]]:
    """By name."""
    found: dict[str, list[float | None]] = {"time_s": [time_s for time_s, _ in rows]}
    return found | {field: [values[i] for _, values in rows] for i, field in enumerate(RECENT_FIELDS)}


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _number(value: Any) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
