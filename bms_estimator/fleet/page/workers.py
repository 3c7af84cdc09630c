"""The workers of a fleet as its page shows them: which are alive, their partitions, their lag. Pure."""

from collections import deque
from typing import Any, NamedTuple

from bms_estimator.fleet.heartbeat import Heartbeat

ALIVE_S = 5.0
"""Heartbeat interval of a worker; the page is given more time than other workers, which take over after 3 s [s]."""
REMEMBERED_S = 300.0
"""Time for which a lost worker is listed [s]."""
OVER_S = 10.0
"""Averaging time of rates [s]."""
MAX_WORKERS = 256
UNHELD = -1


class _Heard(NamedTuple):
    at_s: float
    heartbeat: Heartbeat


class FleetWorkers:
    """Heartbeats of workers; times are on one monotonic clock [s].

    Args:
        partitions: Number of partitions.
    """

    def __init__(self, partitions: int) -> None:
        self.partitions = partitions
        self._heard: dict[str, deque[_Heard]] = {}

    def hear(self, heartbeat: Heartbeat, now_s: float) -> None:
        """Take a heartbeat."""
        if heartbeat.id not in self._heard and len(self._heard) >= MAX_WORKERS:
            return
        heard = self._heard.setdefault(heartbeat.id, deque())
        if heard and heartbeat.blocks < heard[-1].heartbeat.blocks:
            heard.clear()  # restarted
        heard.append(_Heard(now_s, heartbeat))
        while heard[0].at_s < now_s - OVER_S:
            heard.popleft()

    def forget(self) -> None:
        """Reset after a time without messages for which the workers are not responsible."""
        self._heard.clear()

    def unknown(self, now_s: float) -> tuple[int, list[str]]:
        """Return the number of packs without a table row, and some of their names."""
        alive = self._alive(now_s)
        count = sum(heard[-1].heartbeat.unknown_count for heard in alive.values())
        return count, sorted({name for heard in alive.values() for name in heard[-1].heartbeat.unknown})

    def picture(self, now_s: float) -> dict[str, Any]:
        """Return an overview of the workers.

        Returns:
            ``workers`` (each: id, alive, partitions, activity), ``holders`` (index of each partition's worker, -1
            without), ``unheld`` and ``twice`` (partitions), ``lag_s`` (the largest).
        """
        for name in [name for name, heard in self._heard.items() if heard[-1].at_s < now_s - REMEMBERED_S]:
            del self._heard[name]
        alive = self._alive(now_s)
        holders, twice = [UNHELD] * self.partitions, set()
        for place, name in enumerate(sorted(self._heard)):
            for partition in self._heard[name][-1].heartbeat.partitions if name in alive else ():
                if partition >= self.partitions:
                    continue
                if holders[partition] != UNHELD:
                    twice.add(partition)
                holders[partition] = place
        lags = [_lag(heard) for heard in alive.values()]
        return {
            "workers": [_line(self._heard[name], now_s, name in alive) for name in sorted(self._heard)],
            "holders": holders,
            "unheld": [n for n, place in enumerate(holders) if place == UNHELD],
            "twice": sorted(twice),
            "lag_s": max((lag for lag in lags if lag is not None), default=None),
        }

    def _alive(self, now_s: float) -> dict[str, deque[_Heard]]:
        return {name: heard for name, heard in self._heard.items() if heard[-1].at_s >= now_s - ALIVE_S}


def _lag(heard: deque[_Heard]) -> float | None:
    """Return the largest recent lag [s]; None without any block."""
    lags = [each.heartbeat.lag_s for each in heard if each.heartbeat.lag_s is not None]
    return max(lags, default=None)


def _line(heard: deque[_Heard], now_s: float, alive: bool) -> dict[str, Any]:
    first, last = heard[0], heard[-1]
    said, over_s = last.heartbeat, last.at_s - first.at_s

    def rate(now: float, before: float) -> float | None:
        return (now - before) / over_s if over_s > 0.0 and alive else None

    return {
        "id": said.id,
        "alive": alive,
        "leaving": said.leaving,
        "heard_s": now_s - last.at_s,
        "partitions": len(said.partitions),
        "packs": said.packs,
        "lag_s": _lag(heard),
        "blocks_per_s": rate(said.blocks, first.heartbeat.blocks),
        "samples_per_s": rate(said.samples, first.heartbeat.samples),
        "waiting": said.waiting,
        "checkpoint_age_s": said.checkpoint_age_s,
        "rss_mib": said.rss_mib,
        "cpu": rate(said.cpu_s, first.heartbeat.cpu_s),
        "trouble": said.trouble,
    }
