"""Workers on the real server, killed, suspended and added while blocks arrive: none is lost or counted twice."""

import asyncio
import signal
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.membership import assign_partitions
from bms_estimator.fleet.worker.partition import Partition
from tests.fleet.nats_cluster import connected, running
from tests.fleet.workers import Heartbeats, Process, block, end_states, estimated, load_packs, send
from tests.patience import LONG_S

PARTITIONS = 4
PACKS = [f"p{i}" for i in range(8)]


async def test_states_equal_those_of_one_run_after_kills_and_a_suspension(tmp_path: Path) -> None:
    with running(tmp_path, partitions=PARTITIONS) as cluster, ExitStack() as stack:
        nc = await connected(cluster.url)
        await make_streams(nc, partitions=PARTITIONS)
        registry = await load_packs(nc, PACKS)
        assert {subjects.partition_of(pack, PARTITIONS) for pack in PACKS} == set(range(PARTITIONS))
        done = asyncio.Event()

        async def feed() -> int:
            number = 0
            while not done.is_set():
                number += 1
                for pack in PACKS:
                    await send(nc, pack, block(pack, number))
                await asyncio.sleep(0.1)
            return number

        def start(name: str) -> Process:
            process = Process(tmp_path, cluster.url, name, "--checkpoint-s", 1)
            stack.callback(process.kill)
            return process

        a, b = start("a"), start("b")
        feeder = asyncio.create_task(feed())
        async with Heartbeats(nc) as heartbeats:
            await heartbeats.until_held(PARTITIONS, "a", "b")
            a.kill()
            cluster.kill(0)
            c = start("c")
            cluster.start(0)
            await heartbeats.until_held(PARTITIONS, "b", "c")
            b.signal(signal.SIGSTOP)
            await heartbeats.until_held(PARTITIONS, "c")
            b.signal(signal.SIGCONT)
            await b.logged("fenced out")
            await heartbeats.until_held(PARTITIONS, "b", "c")
            done.set()
            sent = await feeder
            await heartbeats.until(
                lambda last: sum(last[name].counters.get("blocks", 0) for name in ("b", "c")) == sent * len(PACKS)
            )
        assert [await b.end(), await c.end()] == [0, 0]
        states = await end_states(nc, registry, PARTITIONS)
        for pack in PACKS:
            state = states[subjects.partition_of(pack, PARTITIONS)].state(pack)
            assert state is not None
            assert state["delivery"]["awaited"][0] == sent + 1
            assert state["estimator"].tobytes() == estimated(registry, pack, sent)
        assert await _hours(nc) == _expected_hours(registry, sent)
        await nc.close()


async def _hours(nc) -> dict[str, bytes]:
    """Return all rows by their ids, without duplicates."""
    js = nc.jetstream(timeout=LONG_S)
    rows = {}
    state = (await js.stream_info(subjects.HOURS_STREAM)).state
    for sequence in range(1, state.last_seq + 1):
        message = await js.get_msg(subjects.HOURS_STREAM, sequence)
        assert message.headers["Nats-Msg-Id"] not in rows
        rows[message.headers["Nats-Msg-Id"]] = message.data
    return rows


def _expected_hours(registry, sent: int) -> dict[str, bytes]:
    partition = Partition(0, registry)
    rows = {}
    for number in range(1, sent + 1):
        for pack in PACKS:
            rows |= dict(partition.take(pack, block(pack, number), partition.sequence + 1).hours)
    return rows


def test_partitions_are_shared_evenly_and_few_move() -> None:
    before, after = assign_partitions(64, ["a", "b"]), assign_partitions(64, ["a", "b", "c"])
    assert sorted(Counter(before).values()) == [32, 32]
    assert max(Counter(after).values()) == 22
    moved = sum(old != new for old, new in zip(before, after, strict=True))
    assert moved <= 28  # the minimum is 20
    assert assign_partitions(3, ["a", "b"]) == assign_partitions(3, ["b", "a"])
