"""Overview of a fleet for its page. No function reads a clock; the time is an argument."""

import contextlib
import json
from collections import deque
from typing import Any

from pydantic_core import from_json

from bms_estimator.fleet.fleet_workers import RATE_S, FleetWorkers
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats.dead_packs import DeadPacks
from bms_estimator.fleet.page.packs import MAX_LISTED, FleetPacks
from bms_estimator.model.clock import iso_utc

MAX_UNKNOWN = 1000
"""Maximum number of packs missing from the table for which the reason is stored."""


class FleetView:
    """State of packs and workers; ``now_s`` is monotonic [s].

    Args:
        partitions: Number of partitions until the server reports it.
        now_s: Present time.
    """

    def __init__(self, partitions: int, now_s: float) -> None:
        self.packs, self.workers = FleetPacks(), FleetWorkers(partitions)
        self.dead_packs = DeadPacks()
        """Packs with dead letters."""
        self._unknown: dict[str, str] = {}
        self._since_s = now_s
        self._received_counts = deque([(now_s, 0)])  # time, and number of states received until then
        self.listening = False
        """True while connected to the server; otherwise the values are outdated."""

    def set_connected(self, now_s: float) -> None:
        """Record that the connection is (re-)established."""
        self._since_s, self.listening = now_s, True
        self.workers.clear()

    def set_disconnected(self) -> None:
        """Record that the connection is lost."""
        self.listening = False

    def receive_worker(self, data: bytes, now_s: float) -> None:
        """Store a worker's heartbeat, unless it is invalid."""
        with contextlib.suppress(ValueError):
            heartbeat = Heartbeat.model_validate(from_json(data, allow_inf_nan=False))  # the page's JSON has no NaN
            self.workers.receive(heartbeat, now_s)

    def receive_unknown(self, name: str, reason: str) -> None:
        """Store the reason why a worker defers the blocks of a pack."""
        self._unknown.pop(name, None)
        self._unknown[name] = reason
        if len(self._unknown) > MAX_UNKNOWN:
            del self._unknown[next(iter(self._unknown))]

    def set_pack_type(self, name: str, type_name: str | None) -> None:
        """Add a pack of the table, or change its type, such as "lfp 4s1p". None: the pack was removed from the table."""
        self.packs.set_type(name, type_name)
        if type_name is not None:
            self._unknown.pop(name, None)

    def overview_json(self, now_s: float, wall_s: float) -> str:
        """Return the overview as one line of JSON."""
        return json.dumps(self.overview(now_s, wall_s), allow_nan=False, separators=(",", ":"))

    def overview(self, now_s: float, wall_s: float) -> dict[str, Any]:
        """Return the overviews of packs and workers, the time, and the duration of uninterrupted reception."""
        result = self.packs.overview(now_s, self._since_s) | self.workers.overview(now_s)
        result["concerns"]["unknown"] = unknown = self._unknown_packs(now_s)
        result["concerns"]["clock"] = clock = self._packs_with_clock_error(now_s)
        result["concerns"]["dead"] = {"count": self.dead_packs.packs, "packs": self.dead_packs.reasons[:MAX_LISTED]}
        result["attention_count"] += unknown["count"] + clock["count"] + self.dead_packs.packs
        return result | {
            "time": iso_utc(wall_s),
            "listening_s": round(now_s - self._since_s, 1),
            "states_per_s": self._rate(now_s),
        }

    def _rate(self, now_s: float) -> float | None:
        """Return the recent rate of states [1/s]."""
        self._received_counts.append((now_s, self.packs.states))
        while len(self._received_counts) > 2 and self._received_counts[1][0] <= now_s - RATE_S:
            self._received_counts.popleft()
        before_s, states = self._received_counts[0]
        return (self.packs.states - states) / (now_s - before_s) if now_s > before_s else None

    def _packs_with_clock_error(self, now_s: float) -> dict[str, Any]:
        """Return number, names and clock errors of packs with a wrong clock [s], the largest errors first."""
        count, errors = self.workers.clock_errors(now_s)
        largest = sorted(errors.items(), key=lambda each: -abs(each[1]))
        return {"count": count, "packs": [[pack, error_s] for pack, error_s in largest][:MAX_LISTED]}

    def _unknown_packs(self, now_s: float) -> dict[str, Any]:
        """Return number, names and reasons of unknown packs. Reasons are deleted once no worker has an unknown pack."""
        count, names = self.workers.unknown_packs(now_s)
        if not count:
            self._unknown.clear()
        newest = dict.fromkeys([*reversed(self._unknown), *names])
        return {"count": count, "packs": [[name, self._unknown.get(name, "")] for name in newest][:MAX_LISTED]}
