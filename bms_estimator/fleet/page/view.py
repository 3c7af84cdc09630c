"""View that the page of a fleet is sent. Pure: clocks are arguments."""

import json
from collections import deque
from typing import Any

from pydantic import ValidationError

from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.page.packs import LISTED, FleetPacks
from bms_estimator.fleet.page.workers import OVER_S, FleetWorkers
from bms_estimator.model.clock import iso_utc

MAX_UNKNOWN = 1000


class FleetView:
    """All that is known; times are monotonic [s].

    Args:
        partitions: Number of partitions until the server reports it.
        now_s: The clock.
    """

    def __init__(self, partitions: int, now_s: float) -> None:
        self.packs, self.workers = FleetPacks(), FleetWorkers(partitions)
        self._unknown: dict[str, str] = {}
        self._since_s = now_s
        self._counted = deque([(now_s, 0)])
        self.listening = False
        """True while connected to the server; otherwise the values are old."""
        self.damaged = 0
        """Heartbeats that were none."""

    def begin(self, now_s: float) -> None:
        """Begin to receive, after a time without a connection."""
        self._since_s, self.listening = now_s, True
        self.workers.forget()

    def end(self) -> None:
        """Mark the server as lost."""
        self.listening = False

    def receive_worker(self, data: bytes, now_s: float) -> None:
        """Take a heartbeat."""
        try:
            self.workers.hear(Heartbeat.model_validate_json(data), now_s)
        except ValidationError:
            self.damaged += 1

    def receive_unknown(self, name: str, why: str) -> None:
        """Record that a worker holds blocks of an unknown pack."""
        self._unknown.pop(name, None)
        self._unknown[name] = why
        if len(self._unknown) > MAX_UNKNOWN:
            del self._unknown[next(iter(self._unknown))]

    def know(self, name: str, kind: str | None) -> None:
        """Set the type of a pack in the table; None removes it."""
        self.packs.list_pack(name, kind)
        if kind is not None:
            self._unknown.pop(name, None)

    def text(self, now_s: float, wall_s: float) -> str:
        """Return the JSON to send, in one line."""
        return json.dumps(self.picture(now_s, wall_s), allow_nan=False, separators=(",", ":"))

    def picture(self, now_s: float, wall_s: float) -> dict[str, Any]:
        """All at a glance: ``FleetPacks.picture``, ``FleetWorkers.picture``, the time and how long has been listened."""
        shown = self.packs.picture(now_s, self._since_s) | self.workers.picture(now_s)
        shown["concerns"]["unknown"] = unknown = self._named_unknown(now_s)
        shown["attention"] += unknown["count"]
        return shown | {
            "time": iso_utc(wall_s),
            "listening_s": round(now_s - self._since_s, 1),
            "states_per_s": self._rate(now_s),
            "damaged": self.packs.damaged + self.damaged,
        }

    def _rate(self, now_s: float) -> float | None:
        """States a second, of late."""
        self._counted.append((now_s, self.packs.states))
        while len(self._counted) > 2 and self._counted[1][0] <= now_s - OVER_S:
            self._counted.popleft()
        before_s, states = self._counted[0]
        return (self.packs.states - states) / (now_s - before_s) if now_s > before_s else None

    def _named_unknown(self, now_s: float) -> dict[str, Any]:
        """Return the unknown packs that workers count; a name stays as long as there are any."""
        count, named = self.workers.unknown(now_s)
        if not count:
            self._unknown.clear()
        newest = dict.fromkeys([*reversed(self._unknown), *named])
        return {"count": count, "packs": [[name, self._unknown.get(name, "")] for name in newest][:LISTED]}
