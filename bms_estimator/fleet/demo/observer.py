"""Heartbeats and estimates that the demo receives, compared with the true SOC of the simulated packs."""

import json
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import DEAD_S, Heartbeat
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet

OBSERVED_PACKS = 100
"""Number of packs whose estimates are compared with the true SOC."""
READ_COUNTERS = ("blocks", "resends", "gaps", "damaged")
"""Counters whose sum is the number of blocks that workers have read from the stream."""


@dataclass
class Observer:
    """Heartbeats and estimates received during a demo.

    Attributes:
        partitions: Numbers of the partitions that contain packs.
        workers: Last heartbeat of each worker and the monotonic clock of its arrival [s].
        lags_s: Lags of all heartbeats [s].
        compared: Number of estimates that are compared with the true SOC.
        within: Number of these estimates whose true SOC is within two standard deviations.
        dead: Names of the killed workers.
    """

    partitions: set[int]
    workers: dict[str, tuple[float, Heartbeat]] = field(default_factory=dict)
    lags_s: list[float] = field(default_factory=list)
    compared: int = 0
    within: int = 0
    dead: set[str] = field(default_factory=set)

    @property
    def alive(self) -> dict[str, Heartbeat]:
        """Last heartbeats of the workers that are alive."""
        now_s = time.monotonic()
        return {
            name: heartbeat
            for name, (received_s, heartbeat) in self.workers.items()
            if now_s - received_s < DEAD_S and name not in self.dead
        }

    @property
    def all_partitions_owned(self) -> bool:
        """True if live workers own all partitions with packs. Workers also claim partitions without packs."""
        return self.partitions.issubset(number for heartbeat in self.alive.values() for number in heartbeat.partitions)

    @property
    def processed(self) -> int:
        """Number of blocks that all workers have processed, including those that were processed again after the kill."""
        return sum(heartbeat.blocks for _, heartbeat in self.workers.values())

    @property
    def counters(self) -> Counter[str]:
        """Sums of the partitions' counters, which count each block once."""
        counters = Counter[str]()
        for heartbeat in self.alive.values():
            counters.update(heartbeat.counters)
        return counters

    @property
    def read_blocks(self) -> int:
        """Number of blocks that workers have read from the stream, without repetitions after the kill."""
        counters = self.counters
        return sum(counters[name] for name in READ_COUNTERS)

    def clock_error_s(self, pack: str) -> float | None:
        """Return the error of the clock of a pack's edge [s]; None if no live worker reports one."""
        reported = (heartbeat.clock_errors.get(pack) for heartbeat in self.alive.values())
        return next((error_s for error_s in reported if error_s is not None), None)

    async def subscribe(self, nc: Client, fleet: SimulatedFleet) -> None:
        """Subscribe to all heartbeats and to the estimates of some packs."""
        index = {name: i for i, name in enumerate(fleet.names)}

        async def on_heartbeat(message: Msg) -> None:
            heartbeat = Heartbeat.model_validate_json(message.data)
            self.workers[heartbeat.id] = time.monotonic(), heartbeat
            if heartbeat.lag_s is not None:
                self.lags_s.append(heartbeat.lag_s)

        async def on_state(message: Msg) -> None:
            estimate = json.loads(message.data)
            pack = np.array([index[message.subject.split(".")[1]]])
            error = estimate["soc"] - float(fleet.soc(pack, np.array([estimate["board_time_s"]]))[0])
            self.compared += 1
            self.within += abs(error) <= 2.0 * estimate["soc_std"]

        await nc.subscribe(subjects.worker(), cb=on_heartbeat)
        for name in fleet.names[:: max(1, len(fleet.names) // OBSERVED_PACKS)]:
            await nc.subscribe(subjects.published(name, "state"), cb=on_state)
        await nc.flush()
