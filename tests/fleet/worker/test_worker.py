"""Workers and server nodes that are killed while simulated edges send and packs are fitted: no block is lost or counted twice.

``make fleet-kills`` sets the numbers of kills, nodes and packs by ``KILLS``, ``NODES`` and ``PACKS``.
"""

import asyncio
import itertools
import math
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack, aclosing
from pathlib import Path

from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.csv_table import read_table
from bms_estimator.fleet.packs.pack_bucket import PackBucket, write_bucket
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.simulation.block_publisher import run_edges
from bms_estimator.fleet.simulation.simulated_edges import RESEND_S, SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.fleet.worker.block_order import REQUEST_EVERY
from bms_estimator.fleet.worker.membership import assign_partitions
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.settings.connections import MqttSettings
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.fleet.workers import Fitter, Heartbeats, Process, end_states
from tests.patience import LONG_S

KILLS, NODES, PACKS, SEED = (
    int(os.environ.get(name, default)) for name, default in (("KILLS", 2), ("NODES", 1), ("PACKS", 8), ("SEED", 1))
)
PARTITIONS = 4
BLOCKS_PER_S = 40.0
"""Rate of the blocks of all edges, at which eight edges send an hour in 12 s [1/s]."""
AGE_DAYS = 10
"""Age of the edges' stores. The clocks of the edges reach the present after 48 min if eight edges send at ``BLOCKS_PER_S``."""
MEAN_UPTIME_S = 1.0
"""Mean time from the restart after a kill to the next kill [s]."""
MAX_DOWNTIME_S = 2.0
"""Maximum delay of the restart after a kill [s]."""
BLOCKS_AFTER_KILLS = 40
"""Number of blocks of each edge after the last kill.

They are needed because a worker requests a missing block when the next one arrives, and a fit when the pack is half an hour old.
"""


async def test_states_and_hour_rows_after_kills_are_those_of_one_run_over_the_stream(tmp_path: Path) -> None:
    with running(tmp_path, NODES, partitions=PARTITIONS) as cluster, ExitStack() as stack:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=PARTITIONS, replicas=NODES)
        fleet = SimulatedFleet(PACKS, seed=SEED, begin_ns=time.time_ns() - AGE_DAYS * 86_400 * 10**9)
        await write_bucket(nc, subjects.PACKS_BUCKET, pack_rows(fleet, tmp_path / "packs.csv"))
        bucket = await read_bucket(nc)
        workers, names = dict[str, Process](), (f"w{number}" for number in itertools.count(1))

        def start_worker() -> None:
            name = next(names)
            workers[name] = Process(tmp_path, ",".join(cluster.urls), name, "--checkpoint-s", 1)
            stack.callback(workers[name].kill)

        def count(last: Mapping[str, Heartbeat], counter: str = "blocks") -> int:
            """Return the sum of a counter over the partitions of the running workers."""
            return sum(last[name].counters.get(counter, 0) for name in workers if name in last)

        start_worker()
        start_worker()
        fitter = Fitter(tmp_path, ",".join(cluster.urls))
        stack.callback(fitter.kill)
        speed = BLOCKS_PER_S * BLOCK_S / PACKS  # simulated seconds per second
        edges, stop = SimulatedEdges(fleet, start_s=time.time(), speed=speed), asyncio.Event()
        settings = MqttSettings(url=tuple(f"mqtt://127.0.0.1:{port}" for port in cluster.mqtt_ports))
        publisher_task = asyncio.create_task(
            run_edges(fleet, edges, settings, connections=2, stop=stop, report=lambda _: None, quiet_s=math.inf)
        )
        async with Heartbeats(nc) as heartbeats:
            await heartbeats.until_held(PARTITIONS, *workers)
            await heartbeats.until(count)
            rng, kills = random.Random(SEED), Counter[str]()
            for kill in range(KILLS):
                await asyncio.sleep(rng.expovariate(1.0 / MEAN_UPTIME_S))
                if kill % 2:
                    kills[await kill_node(cluster, rng)] += 1
                else:
                    workers.pop(rng.choice(sorted(workers))).kill()
                    await asyncio.sleep(rng.uniform(0.0, MAX_DOWNTIME_S))
                    start_worker()
                    kills["worker"] += 1
            await heartbeats.until_held(PARTITIONS, *workers)
            suspended, other = workers  # a suspended worker loses its partitions, and is fenced out when it continues
            workers[suspended].signal(signal.SIGSTOP)
            await heartbeats.until_held(PARTITIONS, other)
            workers[suspended].signal(signal.SIGCONT)
            await workers[suspended].logged("fenced out")
            await heartbeats.until_held(PARTITIONS, *workers)
            edges.last = int(edges.first_unsent.max()) + BLOCKS_AFTER_KILLS
            processed_blocks = 0
            async with asyncio.timeout(5.0 * LONG_S):  # a busy machine may take longer than the limit of one wait
                while processed_blocks < edges.last * PACKS:
                    try:
                        async with asyncio.timeout(2.0 * RESEND_S):
                            await heartbeats.until(lambda last, before=processed_blocks: count(last) > before)
                    except TimeoutError:  # a worker requests a missing block again only when later ones arrive
                        edges.last += REQUEST_EVERY
                    processed_blocks = count(heartbeats.last)
                    assert count(heartbeats.last, "lethal") == 0
        assert processed_blocks == edges.last * PACKS
        stop.set()
        sys.stdout.write(f"{NODES} nodes, kills: {dict(kills)}; {await publisher_task}\n")
        assert [await worker.end() for worker in workers.values()] == [0, 0]
        states = await end_states(nc, bucket.packs, PARTITIONS)
        expected, expected_rows = await run_over_the_stream(nc, bucket.packs, states)
        for pack in fleet.names:
            number = subjects.partition_of(pack, PARTITIONS)
            state, expected_state = states[number].state(pack), expected[number].state(pack)
            assert (state["delivery"]["awaited"][0], state["delivery"]["lost_blocks"][0]) == (edges.last + 1, 0)
            assert state["estimator"].tobytes() == expected_state["estimator"].tobytes()
            assert state["fit"].tobytes() == expected_state["fit"].tobytes()
        fits = sum(partition.counters.get("fits", 0) for partition in expected.values())
        sys.stdout.write(f"{fits} fits of {PACKS} packs\n")
        assert await stored_hours(nc) == expected_rows
        await nc.close()


async def read_bucket(nc: Client) -> PackBucket:
    """Return the table of packs, as soon as its stream has elected a leader that this node knows."""
    bucket = PackBucket(nc)
    async with asyncio.timeout(LONG_S):
        while True:
            try:
                await bucket.refresh()
            except RETRYABLE_ERRORS:
                await asyncio.sleep(0.1)
            else:
                return bucket


def pack_rows(fleet: SimulatedFleet, path: Path) -> dict[str, bytes]:
    """Return the rows of a fleet's table, which is written to ``path``."""
    path.write_text(fleet.table())
    return {pack: row.data for pack, row in read_table(path).packs.items()}


async def kill_node(cluster: NatsCluster, rng: random.Random) -> str:
    """Kill and restart a node, in half of the cases the leader of the blocks' stream. Return its role."""
    leader = cluster.leader(subjects.RAW_STREAM)
    node = leader if leader >= 0 and rng.random() < 0.5 else rng.randrange(NODES)
    cluster.kill(node)
    await asyncio.sleep(rng.uniform(0.0, MAX_DOWNTIME_S))
    await asyncio.to_thread(cluster.start, node)
    return "leader" if node == leader else "node"


async def stored_hours(nc: Client) -> dict[str, bytes]:
    """Return all stored hour rows by pack and hour, after a check that none is stored twice."""
    js = nc.jetstream(timeout=LONG_S)
    ids, rows = set[str](), dict[str, bytes]()
    state = (await js.stream_info(subjects.HOURS_STREAM)).state
    for sequence in range(1, state.last_seq + 1):
        message = await js.get_msg(subjects.HOURS_STREAM, sequence)
        assert message.headers["Nats-Msg-Id"] not in ids
        ids.add(message.headers["Nats-Msg-Id"])
        rows |= without_arrival(message.data)
    return rows


def without_arrival(data: bytes) -> dict[str, bytes]:
    """Return an hour row without the fields of its last block's arrival, by pack and hour."""
    row = Hour.model_validate_json(data).model_copy(update={"revision": None, "received_hour": None})
    return {f"{row.pack}.{row.hour}": row.model_dump_json().encode()}


async def run_over_the_stream(
    nc: Client, registry: PackRegistry, states: Mapping[int, Partition]
) -> tuple[dict[int, Partition], dict[str, bytes]]:
    """Return the partitions of one worker that processes all messages of the stream in order, and their hour rows.

    Results of fits that arrived after the last checkpoints in ``states`` are left out.
    """
    partitions, rows = {number: Partition(number, registry) for number in range(PARTITIONS)}, dict[str, bytes]()
    async with aclosing(read_stream(nc, subjects.RAW_STREAM, "p.>")) as batches:
        async for batch in batches:
            for message in batch:
                _, number, _, pack = message.subject.split(".")
                if message.sequence <= states[int(number)].sequence:
                    for _, row in partitions[int(number)].process(pack, message.data, message.sequence).hours:
                        rows |= without_arrival(row)
    return partitions, rows


def test_partitions_are_shared_evenly_and_few_move_when_a_worker_joins() -> None:
    a, b, c = {"a": ()}, {"b": ()}, {"c": ()}
    before, after = assign_partitions(64, a | b), assign_partitions(64, a | b | c)
    assert sorted(Counter(before).values()) == [32, 32]
    assert max(Counter(after).values()) == 22  # of 64 partitions among three workers
    moved = sum(old != new for old, new in zip(before, after, strict=True))
    assert moved <= 28  # the third worker gets at least 20
    assert assign_partitions(3, a | b) == assign_partitions(3, b | a)


def test_refused_partition_belongs_to_another_worker_and_to_none_if_all_refuse_it() -> None:
    refused_by_a = assign_partitions(8, {"a": (0, 1, 2, 3, 4, 5), "b": ()})
    assert refused_by_a == ["b"] * 6 + ["a"] * 2
    assert assign_partitions(2, {"a": (0,), "b": (0,)})[0] is None
