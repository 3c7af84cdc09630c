"""Workers of a fleet by their heartbeats: live workers, their partitions and their lag. No I/O."""

from collections import deque
from typing import Any, NamedTuple

from bms_estimator.fleet.heartbeat import Heartbeat

LOST_S = 5.0
"""Time without a heartbeat after which a worker counts as lost [s]. It exceeds ``heartbeat.DEAD_S``, after which other workers
take over."""
LISTED_S = 300.0
"""Time for which a lost worker stays listed [s]."""
RATE_S = 10.0
"""Default averaging time of rates [s]."""
MAX_WORKERS = 256
"""Maximum number of workers. Heartbeats of further workers are ignored."""
NO_WORKER = -1
"""Worker index of a partition that no worker owns."""


class _Received(NamedTuple):
    """Heartbeat and the time of its arrival."""

    at_s: float
    heartbeat: Heartbeat


class FleetWorkers:
    """Recent heartbeats of all workers; times are of one monotonic clock [s].

    Args:
        partitions: Number of partitions.
        window_s: Time over which rates are averaged and the largest lag is found [s].
    """

    def __init__(self, partitions: int, window_s: float = RATE_S) -> None:
        self.partitions, self._window_s = partitions, window_s
        self._by_worker: dict[str, deque[_Received]] = {}

    def receive(self, heartbeat: Heartbeat, now_s: float) -> None:
        """Store a heartbeat."""
        if heartbeat.id not in self._by_worker and len(self._by_worker) >= MAX_WORKERS:
            return
        received = self._by_worker.setdefault(heartbeat.id, deque())
        if received and heartbeat.blocks < received[-1].heartbeat.blocks:
            received.clear()  # the worker has restarted
        received.append(_Received(now_s, heartbeat))
        while received[0].at_s < now_s - self._window_s:
            received.popleft()

    def clear(self) -> None:
        """Remove all heartbeats, after a time without a connection."""
        self._by_worker.clear()

    def heartbeats(self, now_s: float) -> list[Heartbeat]:
        """Return the last heartbeat of each live worker, with its largest recent lag."""
        return [
            received[-1].heartbeat.model_copy(update={"lag_s": _max_lag_s(received)})
            for received in self._alive(now_s).values()
        ]

    def unknown_packs(self, now_s: float) -> tuple[int, list[str]]:
        """Return the number of packs that are missing in the table of packs, and some of their names."""
        alive = self._alive(now_s)
        count = sum(received[-1].heartbeat.unknown_count for received in alive.values())
        return count, sorted({name for received in alive.values() for name in received[-1].heartbeat.unknown})

    def clock_errors(self, now_s: float) -> tuple[int, dict[str, float]]:
        """Return the number of packs with a wrong clock, and the errors of some of them [s]."""
        heartbeats = [received[-1].heartbeat for received in self._alive(now_s).values()]
        errors = {pack: error_s for heartbeat in heartbeats for pack, error_s in heartbeat.clock_errors.items()}
        return sum(heartbeat.clock_error_count for heartbeat in heartbeats), errors

    def overview(self, now_s: float) -> dict[str, Any]:
        """Return an overview of the workers.

        Returns:
            ``workers`` (each: id, alive, partitions, activity), ``holders`` (index of each partition's worker, or -1),
            ``unheld`` and ``twice`` (partitions with no worker or several), ``refused`` (of ``unheld``: those whose
            checkpoints no worker can read), ``lag_s`` (the largest).
        """
        for name in [name for name, received in self._by_worker.items() if received[-1].at_s < now_s - LISTED_S]:
            del self._by_worker[name]
        alive = self._alive(now_s)
        holders, twice = [NO_WORKER] * self.partitions, set()
        for index, name in enumerate(sorted(self._by_worker)):
            for partition in self._by_worker[name][-1].heartbeat.partitions if name in alive else ():
                if partition >= self.partitions:
                    continue
                if holders[partition] != NO_WORKER:
                    twice.add(partition)
                holders[partition] = index
        lags = [_max_lag_s(received) for received in alive.values()]
        refused = {each.partition for received in alive.values() for each in received[-1].heartbeat.refused}
        return {
            "workers": [
                _worker_overview(self._by_worker[name], now_s, name in alive) for name in sorted(self._by_worker)
            ],
            "holders": holders,
            "unheld": [n for n, index in enumerate(holders) if index == NO_WORKER],
            "twice": sorted(twice),
            "refused": sorted({n for n in refused if n < self.partitions and holders[n] == NO_WORKER}),
            "lag_s": max((lag for lag in lags if lag is not None), default=None),
        }

    def _alive(self, now_s: float) -> dict[str, deque[_Received]]:
        return {name: received for name, received in self._by_worker.items() if received[-1].at_s >= now_s - LOST_S}


def _max_lag_s(received: deque[_Received]) -> float | None:
    """Return the largest recent lag [s]; None without any block."""
    lags = [each.heartbeat.lag_s for each in received if each.heartbeat.lag_s is not None]
    return max(lags, default=None)


def _worker_overview(received: deque[_Received], now_s: float, alive: bool) -> dict[str, Any]:
    first, last = received[0], received[-1]
    heartbeat, span_s = last.heartbeat, last.at_s - first.at_s
    rate = (heartbeat.samples - first.heartbeat.samples) / span_s if span_s > 0.0 and alive else None
    return {
        "id": heartbeat.id,
        "alive": alive,
        "leaving": heartbeat.leaving,
        "heard_s": now_s - last.at_s,
        "partitions": len(heartbeat.partitions),
        "packs": heartbeat.packs,
        "lag_s": _max_lag_s(received),
        "samples_per_s": rate,
        "waiting": heartbeat.waiting,
        "trouble": heartbeat.trouble,
        "checkpoint_formats": [heartbeat.oldest_checkpoint_format, heartbeat.checkpoint_format],
        "refused": [[each.partition, each.format] for each in heartbeat.refused],
    }
