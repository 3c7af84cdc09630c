"""Attacks on the real server with the token of one edge. They harm only the pack of that edge."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import nats
import pytest
from nats.aio.client import Client
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.edge.block import decode
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.nats.streams import MAX_BLOCK_BYTES, make_streams, max_blocks_of_pack
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.worker.block_order import MAX_EARLY_REPEATS
from bms_estimator.fleet.worker.worker import Options, work
from tests.fleet.nats_cluster import running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.tenant import Tenant, heavy_block, numbered, one_tenant
from tests.fleet.workers import PACK_ROW, Heartbeats, block, end_states, load_packs, until
from tests.patience import LONG_S

PARTITIONS = 4
RAW_BYTES = 8 << 20
"""Size limit of the stream [bytes]; small, so that a test can fill it."""
FLOOD_BLOCKS = 40
"""Number of blocks that an attacker sends. Each of them takes a worker a tenth of a second."""
FLOOD_BYTES = 715_000
"""Total size of the blocks with too many samples that an attacker sends [bytes]. It gives the number of blocks."""
MQTT_FAILURE = 0x80
"""Return code of a rejected MQTT subscription."""
FORMER_SUBJECT = "p.*.raw.*"
"""Subject of ``RAW`` in the previous version, in which the server mapped the edges' subjects before storing."""


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Tenant]:
    """Return a running server with one tenant that has streams."""
    with one_tenant(tmp_path) as tenant:
        asyncio.run(tenant.make_streams(PARTITIONS, 1 << 30))
        yield tenant


async def stored_counts(nc: Client, last: bytes) -> dict[str, int]:
    """Return the number of messages of each subject in ``RAW``, once the last sent message is in it.

    The server acknowledges an MQTT publish before the message is in the stream.
    """
    js = nc.jetstream()
    deadline = time.monotonic() + LONG_S
    while time.monotonic() < deadline:
        info = await js.stream_info(subjects.RAW_STREAM, subjects_filter=">")
        if info.state.messages and (await js.get_msg(subjects.RAW_STREAM, info.state.last_seq)).data == last:
            return dict(info.state.subjects or {})
        await asyncio.sleep(0.02)
    raise AssertionError(info.state)


def subject(pack: str) -> str:
    """Return the subject of a pack's blocks in ``RAW``."""
    return subjects.stored_raw(subjects.partition_of(pack, PARTITIONS), pack)


async def test_edge_cannot_write_to_other_packs_or_choose_the_partition(fleet: Tenant) -> None:
    reader = await fleet.program(Role.READER)
    async with fleet.edge("attacker") as edge:
        for partition in (*range(PARTITIONS), "x", "invented", "64"):
            await edge.publish(f"p/{partition}/raw/attacker", b"evil", qos=1)
        for i in range(200):
            await edge.publish(f"p/{i}x/raw/attacker", b"evil", qos=1)
            await edge.publish(f"raw/invented{i}", b"evil", qos=1)
        codes = [(await edge.subscribe(f"edge/attacker/{i}", qos=1))[0].value for i in range(20)]
        await edge.publish("raw/attacker", b"own", qos=1)
    assert await stored_counts(reader, b"own") == {subject("attacker"): 1}
    assert set(codes) == {MQTT_FAILURE}
    await reader.close()


async def test_blocks_of_an_attacker_evict_no_block_of_another_pack(fleet: Tenant) -> None:
    await fleet.make_streams(PARTITIONS, RAW_BYTES)
    reader = await fleet.program(Role.READER)
    async with fleet.edge("honest") as edge:
        for _ in range(5):
            await edge.publish("raw/honest", b"block", qos=1)
    junk = bytes(MAX_BLOCK_BYTES // 2)
    async with fleet.edge("attacker") as edge:
        for _ in range(2 * RAW_BYTES // len(junk)):
            await edge.publish("raw/attacker", junk, qos=1)
        await edge.publish("raw/attacker", b"last", qos=1)
    counts = await stored_counts(reader, b"last")
    assert counts == {subject("honest"): 5, subject("attacker"): max_blocks_of_pack(RAW_BYTES)}
    await reader.close()


async def test_too_large_message_is_not_stored(fleet: Tenant) -> None:
    reader = await fleet.program(Role.READER)
    async with fleet.edge("attacker") as edge:
        await edge.publish("raw/attacker", bytes(MAX_BLOCK_BYTES + 1), qos=1)
        await edge.publish("raw/attacker", bytes(MAX_BLOCK_BYTES - 1024), qos=1)
    assert await stored_counts(reader, bytes(MAX_BLOCK_BYTES - 1024)) == {subject("attacker"): 1}
    await reader.close()


async def test_block_that_the_server_rejects_each_time_counts_as_lost(fleet: Tenant) -> None:
    admin, reader = await fleet.program(Role.ADMIN), await fleet.program(Role.READER)
    await write_bucket(admin, subjects.PACKS_BUCKET, {"p1": PACK_ROW})
    states = await reader.subscribe(subjects.published("p1", "state"))
    await reader.flush()
    async with Heartbeats(reader) as heartbeats, worker(fleet), fleet.edge("p1") as edge:
        await edge.publish("raw/p1", block("p1", 1), qos=1)
        await states.next_msg(LONG_S)
        for _ in range(MAX_EARLY_REPEATS):  # as an edge does when block 2 is requested
            await edge.publish("raw/p1", bytes(MAX_BLOCK_BYTES + 1), qos=1)
            await edge.publish("raw/p1", block("p1", 3), qos=1)
        await states.next_msg(LONG_S)
        await wait_for_count(heartbeats, "lost_blocks", 1)
    await admin.close()
    await reader.close()


async def test_stream_of_the_previous_version_is_updated_and_keeps_its_blocks(tmp_path: Path) -> None:
    with running(tmp_path) as cluster:
        nc = await nats.connect(cluster.url)
        await nc.jetstream().add_stream(
            name=subjects.RAW_STREAM, subjects=[FORMER_SUBJECT], metadata={"bms.partitions": "4"}
        )
        await nc.jetstream().publish(subject("p1"), b"before")
        await make_streams(nc, partitions=PARTITIONS, raw_bytes=RAW_BYTES)
        await nc.jetstream().publish(subjects.raw("p1"), b"after")
        assert await stored_counts(nc, b"after") == {subject("p1"): 2}
        await nc.close()


@asynccontextmanager
async def worker(fleet: Tenant) -> AsyncIterator[None]:
    """Run a worker with the tenant's credentials, and shut it down at the end."""
    stop = asyncio.Event()
    working = asyncio.create_task(work(Options(fleet.cluster.url, "w", fleet.file(Role.WORKER)), stop))
    try:
        yield
    finally:
        stop.set()
        await working


async def wait_for_count(heartbeats: Heartbeats, name: str, count: int) -> None:
    """Wait until a counter of the worker has reached a value."""
    await heartbeats.until(lambda last: any(each.counters.get(name, 0) >= count for each in last.values()))


@pytest.mark.parametrize(
    ("samples", "seconds", "reason"),
    [
        (65_535, 65_535.0, "65535 samples: at most 20000"),
        (20_000, 3.0, "20000 samples in 3 s: at most 1000 a second, and 7000 more"),
    ],
)
async def test_blocks_with_too_many_samples_are_rejected_and_other_packs_are_not_delayed(
    fleet: Tenant, samples: int, seconds: float, reason: str
) -> None:
    admin, reader = await fleet.program(Role.ADMIN), await fleet.program(Role.READER)
    await write_bucket(admin, subjects.PACKS_BUCKET, {"p1": PACK_ROW, "attacker": PACK_ROW})
    states = await reader.subscribe(subjects.published("*", "state"))
    await reader.flush()
    dense_block = heavy_block(samples, seconds / samples)
    count = FLOOD_BYTES // len(dense_block)
    async with fleet.edge("attacker") as attacker, fleet.edge("p1") as other_edge:
        for number in range(1, count + 1):
            await attacker.publish("raw/attacker", numbered(dense_block, number), qos=1)
        await other_edge.publish("raw/p1", block("p1", 1), qos=1)
    with capture_logs() as logs:
        async with Heartbeats(reader) as heartbeats, worker(fleet):
            assert (await states.next_msg(LONG_S)).subject == subjects.published("p1", "state")
            await wait_for_count(heartbeats, "too_dense", count)
    # the worker logs only the first rejection of a pack
    rejections = [line for line in logs if line["event"] == "a block is rejected"]
    assert [(line["pack"], line["reason"]) for line in rejections] == [("attacker", reason)]
    await admin.close()
    await reader.close()


@pytest.mark.thorough
async def test_flood_of_blocks_delays_only_its_own_pack(fleet: Tenant) -> None:
    admin, reader = await fleet.program(Role.ADMIN), await fleet.program(Role.READER)
    registry = await load_packs(admin, ["p1", "attacker"])
    partitions = {subjects.partition_of(pack, PARTITIONS) for pack in ("p1", "attacker")}
    assert len(partitions) == 1  # both packs are in one partition
    states = await reader.subscribe(subjects.published("*", "state"))
    await reader.flush()
    heavy = heavy_block(samples=20_000, period_s=1.0)
    async with fleet.edge("attacker") as attacker, fleet.edge("p1") as other_edge:
        for number in range(1, FLOOD_BLOCKS + 1):
            await attacker.publish("raw/attacker", numbered(heavy, number), qos=1)
        await other_edge.publish("raw/p1", block("p1", 1), qos=1)
    async with worker(fleet):
        earlier_states = 0
        while (await states.next_msg(LONG_S)).subject != subjects.published("p1", "state"):
            earlier_states += 1
        assert earlier_states < FLOOD_BLOCKS // 2
    async with Heartbeats(reader) as heartbeats, worker(fleet):  # continues from the checkpoint of the first worker
        await wait_for_count(heartbeats, "blocks", FLOOD_BLOCKS + 1)
    state = (await end_states(admin, registry, PARTITIONS))[subjects.partition_of("attacker", PARTITIONS)].state(
        "attacker"
    )
    assert state is not None
    estimator = make_estimator(*(registry("attacker") or ()))
    for _ in range(FLOOD_BLOCKS):
        estimator.run(decode(heavy).samples)
    assert estimates_of(state["estimator"]) == estimates_of(estimator.record)
    await admin.close()
    await reader.close()


async def test_worker_rejects_a_block_of_a_pack_that_belongs_to_another_partition(fleet: Tenant) -> None:
    admin = await fleet.program(Role.ADMIN)
    await write_bucket(admin, subjects.PACKS_BUCKET, {"p1": PACK_ROW})
    wrong_partition = (subjects.partition_of("p1", PARTITIONS) + 1) % PARTITIONS
    # the stream of the previous version accepts any partition
    await admin.jetstream().update_stream(
        name=subjects.RAW_STREAM,
        subjects=[FORMER_SUBJECT],
        metadata={"bms.partitions": str(PARTITIONS)},
        allow_direct=True,
    )
    await admin.jetstream().publish(subjects.stored_raw(wrong_partition, "p1"), block("p1", 1))
    with capture_logs() as logs:
        async with worker(fleet):
            await until(lambda: [line for line in logs if line["event"] == "a block is rejected"], lambda: logs)
    (rejection,) = [line for line in logs if line["event"] == "a block is rejected"]
    assert (rejection["partition"], rejection["reason"]) == (wrong_partition, "the pack belongs to another partition")
    await admin.close()
