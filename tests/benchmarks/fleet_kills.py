"""Workers and the server killed at random, without losing or repeating a sample. ``make fleet-kills ARGS="--kills 100"``.

Real processes on the loopback, simulated edges that go on sending. Each kill is SIGKILL, at a moment that a seed chooses;
who was killed is started again. Of three nodes one is down at a time, the leader of the blocks' stream as often as not.
Then the workers are stopped as an operator does it, and each pack's state in the last checkpoints is compared, bit by
bit, with one estimator that has taken all of the pack's samples in one go.
"""

import argparse
import asyncio
import contextlib
import random
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError

from bms_estimator.edge import subjects
from bms_estimator.edge.block import decode
from bms_estimator.estimator.estimator import Estimator, make_estimator
from bms_estimator.fleet.heartbeat import DEAD_S, Heartbeat
from bms_estimator.fleet.nats.stored_messages import stored
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet
from bms_estimator.fleet.worker.checkpoint_store import Pointer
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.service.kernel_warm_up import load_kernels
from tests.benchmarks.fleet_rig import Rig, make, rig
from tests.patience import LONG_S

WORKERS, CHECKPOINT_S = 2, 4.0
OF_WORKERS = 0.5
"""Part of the kills; the others are of the server's nodes."""
OF_LEADERS = 0.5
"""Part of the nodes' kills, where there are three."""
MAX_AWAY_S = 2.0
"""Delay before a killed process is restarted."""
BLOCKS_AFTER = 2
"""Number of blocks that each edge sends after the last kill, since a missing block is requested when the next one
arrives."""
LOOKS = 20
"""Number of equal readings, a tenth of a second apart, of counters and stream."""
MAX_WRONG = 20
"""Maximum number of error lines."""


@dataclass(frozen=True)
class Plan:
    """One run.

    Attributes:
        nodes: Of the server, 1 or 3.
        mean_s: From one kill to the next, as who was killed is there again.
        speed: The packs' seconds per second.
    """

    nodes: int
    kills: int
    packs: int
    seed: int
    mean_s: float = 1.0
    speed: float = 60.0
    partitions: int = 8


@dataclass
class Outcome:
    """Result of a run.

    Attributes:
        killed: How often whom.
        blocks: In the stream: each once.
        again: In the stream: that came once more.
        wrong: In words, of each pack whose state is not that of its samples; empty: none.
        counters: Of all partitions, by their last checkpoints.
    """

    killed: Counter[str] = field(default_factory=Counter)
    blocks: int = 0
    again: int = 0
    packs: int = 0
    wrong: list[str] = field(default_factory=list)
    counters: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        killed = ", ".join(f"{count} of a {what}" for what, count in sorted(self.killed.items()))
        counted = ", ".join(f"{name} {count:,}" for name, count in sorted(self.counters.items()) if count)
        return (
            f"{self.killed.total()} kills: {killed}\n"
            f"{self.blocks:,} blocks of {self.packs:,} packs in the stream, {self.again:,} more came again\n"
            f"taken as the checkpoints say: {counted}\n"
            f"{len(self.wrong)} packs whose end state is not that of all their samples, bit by bit"
        )


@dataclass
class Sent:
    """Blocks of a pack in the stream.

    Attributes:
        numbers: Of its blocks, and how often each came.
        awaited: The number after those that came in their order, whatever came too early or again.
    """

    numbers: Counter[int] = field(default_factory=Counter)
    awaited: int = 1

    def add(self, number: int) -> None:
        """One more message."""
        self.numbers[number] += 1
        self.awaited += number == self.awaited

    @property
    def last(self) -> int:
        """The highest number."""
        return max(self.numbers, default=0)


def main() -> None:
    """Kill, compare, and end with 1 where a state is wrong."""
    parser = argparse.ArgumentParser(prog="make fleet-kills ARGS=...", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="of each of the two")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 3], choices=(1, 3))
    parser.add_argument("--packs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    load_kernels()
    wrong = 0
    for nodes in arguments.nodes:
        began_s = time.monotonic()
        plan = Plan(nodes, arguments.kills, arguments.packs, arguments.seed)
        outcome = run(plan, _say)
        of = "1 node" if nodes == 1 else f"{nodes} nodes"
        _say(f"{of}, seed {plan.seed}, {time.monotonic() - began_s:.0f} s\n{outcome}")
        for line in outcome.wrong[:MAX_WRONG]:
            _say(line)
        wrong += len(outcome.wrong)
    sys.exit(wrong > 0)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def run(plan: Plan, said: Callable[[str], object] = lambda _: None) -> Outcome:
    """Run a plan; ``said`` receives each kill."""
    with (
        tempfile.TemporaryDirectory() as folder,
        rig(Path(folder), plan.nodes, partitions=plan.partitions) as fleet_rig,
    ):
        return asyncio.run(_run(fleet_rig, plan, said))


async def _run(fleet_rig: Rig, plan: Plan, said: Callable[[str], object]) -> Outcome:
    begin_s = int(time.time())
    fleet = SimulatedFleet(plan.packs, seed=plan.seed, begin_ns=begin_s * 10**9)
    await make(fleet_rig, partitions=plan.partitions)
    await asyncio.to_thread(fleet_rig.load, fleet)
    for _ in range(WORKERS):
        fleet_rig.start_worker(checkpoint_s=CHECKPOINT_S)
    begin = datetime.fromtimestamp(begin_s, UTC).replace(tzinfo=None).isoformat()
    edges = fleet_rig.simulate(plan.packs, seed=plan.seed, begin=begin, speed=plan.speed)
    nc = await fleet_rig.connected()
    outcome, heard = Outcome(packs=plan.packs), await _hear(nc)
    try:
        await _until(lambda: _counted(heard) > 0)
        await asyncio.to_thread(_kill, fleet_rig, plan, outcome, said)
        await _until(lambda: _held(heard) == set(range(plan.partitions)))
        await _until_whole(nc, fleet)
        edges.terminate()
        await asyncio.to_thread(edges.wait, LONG_S)
        await _until_all_counted(nc, heard)
        await asyncio.to_thread(fleet_rig.stop_workers)
        await _judge(nc, fleet, plan, outcome)
    finally:
        edges.kill()
        await nc.close()
    return outcome


def _kill(fleet_rig: Rig, plan: Plan, outcome: Outcome, said: Callable[[str], object]) -> None:
    dice = random.Random(plan.seed)
    for kill in range(plan.kills):
        time.sleep(dice.expovariate(1.0 / plan.mean_s))
        whom = "worker" if dice.random() < OF_WORKERS else "node"
        if whom == "worker":
            fleet_rig.kill_worker(dice.choice(sorted(fleet_rig.workers)))
            time.sleep(dice.uniform(0.0, MAX_AWAY_S))
            fleet_rig.start_worker(checkpoint_s=CHECKPOINT_S)
        else:
            leader = fleet_rig.engine.leader(subjects.RAW_STREAM)
            node = leader if leader >= 0 and dice.random() < OF_LEADERS else dice.randrange(plan.nodes)
            whom = "leader" if node == leader and plan.nodes > 1 else whom
            fleet_rig.engine.kill(node)
            time.sleep(dice.uniform(0.0, MAX_AWAY_S))
            fleet_rig.engine.start(node)
        outcome.killed[whom] += 1
        said(f"kill {kill + 1}: a {whom}")


async def _hear(nc: Client) -> dict[str, tuple[float, Heartbeat]]:
    """Last heartbeats of all workers by name, with the moment of a monotonic clock [s]."""
    heard: dict[str, tuple[float, Heartbeat]] = {}

    async def beat(message: Msg) -> None:
        said = Heartbeat.model_validate_json(message.data)
        heard[said.id] = time.monotonic(), said

    await nc.subscribe(subjects.worker(), cb=beat)
    return heard


def _counted(heard: dict[str, tuple[float, Heartbeat]]) -> int:
    """Return the number of messages that the partitions' counters include, by their live owners."""
    now_s = time.monotonic()
    return sum(
        beat.counters.get(what, 0)
        for heard_s, beat in heard.values()
        for what in ("blocks", "resends", "gaps")
        if now_s - heard_s < DEAD_S
    )


def _held(heard: dict[str, tuple[float, Heartbeat]]) -> set[int]:
    """Return the partitions with a live owner."""
    now_s = time.monotonic()
    return {number for heard_s, beat in heard.values() if now_s - heard_s < DEAD_S for number in beat.partitions}


async def _until_whole(nc: Client, fleet: SimulatedFleet) -> None:
    """Until the stream has all blocks of each pack in their order, some sent since among them."""
    before = await _sent(nc)
    async with asyncio.timeout(LONG_S):
        while True:
            now = await _sent(nc)
            last = {pack: max(now[pack].last, before[pack].last + BLOCKS_AFTER) for pack in fleet.names}
            if all(now[pack].awaited > last[pack] for pack in fleet.names):
                return
            await asyncio.sleep(0.5)


async def _sent(nc: Client) -> dict[str, Sent]:
    """Return the blocks in the stream by pack."""
    sent: dict[str, Sent] = defaultdict(Sent)
    last = await _last_sequence(nc)
    async for message in stored(nc, subjects.RAW_STREAM, "p.*.raw.*", 1, last):
        sent[message.subject.rpartition(".")[2]].add(decode(message.data).number)
    return sent


async def _until_all_counted(nc: Client, heard: dict[str, tuple[float, Heartbeat]]) -> None:
    """Wait until no message arrives and all are counted, because the server may still store messages of the edges."""
    looks = 0
    async with asyncio.timeout(LONG_S):
        while looks < LOOKS:
            looks = looks + 1 if _counted(heard) == await _last_sequence(nc) else 0
            await asyncio.sleep(0.1)


async def _last_sequence(nc: Client) -> int:
    """Return the last sequence of the stream; retried until a server responds."""
    async with asyncio.timeout(LONG_S):
        while True:
            with contextlib.suppress(NatsError, TimeoutError):
                return (await nc.jetstream().stream_info(subjects.RAW_STREAM)).state.last_seq
            await asyncio.sleep(0.1)


async def _until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(LONG_S):
        while not true():  # noqa: ASYNC110 - it has no other way to tell
            await asyncio.sleep(0.1)


async def _judge(nc: Client, fleet: SimulatedFleet, plan: Plan, outcome: Outcome) -> None:
    """Compare the stream, the checkpoints, and one estimator over all samples."""
    numbers = {pack: sent.numbers for pack, sent in (await _sent(nc)).items()}
    bucket = PackBucket(nc)
    await bucket.refresh()
    partitions = {number: await _last(nc, number, bucket) for number in range(plan.partitions)}
    for partition in partitions.values():
        outcome.counters.update(partition.counters if partition else {})
    outcome.blocks = sum(len(each) for each in numbers.values())
    outcome.again = sum(each.total() for each in numbers.values()) - outcome.blocks
    for i, pack in enumerate(fleet.names):
        partition = partitions[subjects.partition_of(pack, plan.partitions)]
        state = partition.state(pack) if partition else None
        found = bucket.packs(pack)
        if state is None or found is None:
            outcome.wrong.append(f"{pack}: in no checkpoint")
            continue
        estimator = _replayed(fleet, i, len(numbers[pack]), make_estimator(*found))
        outcome.wrong += _differences(pack, numbers[pack], state[0], estimator)


def _replayed(fleet: SimulatedFleet, pack: int, blocks: int, estimator: Estimator) -> Estimator:
    for number in range(1, blocks + 1):
        estimator.run(fleet.samples(np.array([pack]), np.array([number]))[0])
    return estimator


def _differences(pack: str, numbers: Counter[int], state: np.void, estimator: Estimator) -> list[str]:
    wrong = []
    delivery, blocks = state["delivery"], len(numbers)
    if sorted(numbers) != list(range(1, blocks + 1)):
        wrong.append(f"{pack}: not in the stream: {sorted(set(range(1, max(numbers))) - set(numbers))[:10]}")
    if (delivery["blocks"], delivery["awaited"], delivery["lost_blocks"]) != (blocks, blocks + 1, 0):
        wrong.append(
            f"{pack}: {blocks} blocks in the stream, taken {delivery['blocks']}, lost {delivery['lost_blocks']}"
        )
    if state["estimator"].tobytes() != estimator.record.tobytes():
        wrong.append(f"{pack}: its estimator's record is another")
    return wrong


async def _last(nc: Client, number: int, bucket: PackBucket) -> Partition | None:
    """Return a partition from its last checkpoint; None: it had no owner."""
    js = nc.jetstream(timeout=LONG_S)
    checkpoints, states = await js.key_value(subjects.CHECKPOINTS_BUCKET), await js.object_store(subjects.STATES_BUCKET)
    entry = await checkpoints.get(f"p{number}")
    kept = Pointer.model_validate_json(entry.value or b"").kept
    if not kept:
        return None
    data = (await states.get(kept[0].object)).data or b""
    return Partition.restore(number, bucket.packs, data)


if __name__ == "__main__":
    main()
