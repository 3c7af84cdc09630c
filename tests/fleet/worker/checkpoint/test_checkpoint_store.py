"""Checkpoints on the real server: last and daily ones, damaged ones, unreadable ones, and those of a fenced worker."""

import asyncio
import json
from contextlib import suppress

import nats
import pytest
from nats.aio.client import Client
from nats.aio.subscription import Subscription
from nats.js.errors import APIError
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import RefusedPartition
from bms_estimator.fleet.nats.stream_sizes import DAILY_CHECKPOINTS
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import (
    FORMAT,
    PartitionCheckpoint,
    UnreadableFormatError,
)
from bms_estimator.fleet.worker.checkpoint.checkpoint_objects import MESSAGE_BYTES
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CHECKPOINTS_PER_PARTITION, open_checkpoints
from bms_estimator.fleet.worker.checkpoint.claims import FencedError
from bms_estimator.fleet.worker.worker import Options, work
from tests.fleet.checkpoints import STATES_STREAM, Clock, chunk_subject, load, raw
from tests.fleet.nats_cluster import NatsCluster, running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import PERIOD_S, SAMPLES, Heartbeats, block, end_states, estimated, load_packs, send, until
from tests.patience import LONG_S

CHECKPOINT_BYTES = 300_000
"""Size of a checkpoint, which the object store splits into several messages [bytes]."""
FORMAT_OFFSET = 8
"""Offset of the format in a checkpoint [bytes]."""


@pytest.fixture(autouse=True)
def noon(clock: Clock) -> None:
    """Set the clock of all checkpoints."""


@pytest.fixture(scope="module")
def partitions() -> int:
    return 2


@pytest.fixture
def cluster(module_cluster: NatsCluster) -> NatsCluster:
    return module_cluster


async def _objects(nc: Client, partition: int) -> set[str]:
    """Return the names of the stored checkpoints of a partition."""
    return {
        each.name
        for each in await (await nc.jetstream().object_store(subjects.STATES_BUCKET)).list()
        if each.name.startswith(f"p{partition}-")
    }


async def test_last_two_checkpoints_and_the_first_of_the_day_are_stored_and_damaged_ones_are_logged_and_skipped(nc):
    store = await open_checkpoints(nc, "a")
    claim = await store.claim(7)
    written = [bytes([i]) * CHECKPOINT_BYTES for i in range(3)]
    for i, data in enumerate(written):
        claim = await store.write(claim, raw(i, data[:1], b"", data[1:]), file_format=FORMAT)
    assert await load(store, claim) == [written[2], written[1], written[0]]
    newest, previous = claim.pointer.kept

    subject = await chunk_subject(nc, newest.object)
    await nc.jetstream().purge_stream(STATES_STREAM, subject=subject, keep=1)  # only the last chunk remains
    with capture_logs() as logs:
        assert await load(store, claim) == [written[1], written[0]]
    assert logs[0]["event"].startswith("a checkpoint is damaged")
    assert logs[0]["object"] == newest.object
    subject = await chunk_subject(nc, previous.object)
    await nc.jetstream().purge_stream(STATES_STREAM, subject=subject)  # all chunks are replaced
    await nc.jetstream().publish(subject, b"x" * CHECKPOINT_BYTES)
    assert await load(store, claim) == [written[0]]  # the first one of the day


async def test_worker_whose_partition_another_one_claimed_cannot_write_and_leaves_no_object(nc):
    former, owner = await open_checkpoints(nc, "former"), await open_checkpoints(nc, "owner")
    claim = await former.write(await former.claim(8), raw(1, b"1"), file_format=FORMAT)
    other_claim = await owner.claim(8)
    assert await owner.claims.confirm(other_claim) == other_claim
    with pytest.raises(FencedError, match="owner"):
        await former.claims.confirm(claim)
    with pytest.raises(FencedError, match="owner"):
        await former.write(claim, raw(2, b"2"), file_format=FORMAT)
    assert await _objects(nc, 8) == {claim.pointer.kept[0].object}
    assert await load(owner, other_claim) == [b"1"]
    # a worker was killed between two chunks of an object; the next claim removes them
    await nc.jetstream().publish(f"$O.{subjects.STATES_BUCKET}.C.{other_claim.pointer.next}", b"3")
    assert await load(former, await former.claim(8)) == [b"1"]
    assert await _objects(nc, 8) == {claim.pointer.kept[0].object}
    remaining_subjects = (await nc.jetstream().stream_info(STATES_STREAM, subjects_filter=">")).state.subjects
    assert sum(".C.p8-" in subject for subject in remaining_subjects) == 1


async def test_own_write_whose_response_was_lost_does_not_count_as_one_of_another_worker(nc):
    store, other = await open_checkpoints(nc, "a"), await open_checkpoints(nc, "b")
    claim = await store.claim(9)
    await store.write(claim, raw(1, b"1"), file_format=FORMAT)
    written = await store.write(claim, raw(2, b"2"), file_format=FORMAT)  # with the old claim, as after a lost response
    assert await load(store, written) == [b"2", b"1"]
    assert await _objects(nc, 9) == {each.object for each in written.pointer.checkpoints}
    await store.write(written, raw(3, b"3"), file_format=FORMAT)
    other_claim = await other.claim(9)
    with pytest.raises(FencedError, match="b"):
        await store.write(written, raw(4, b"4"), file_format=FORMAT)
    assert await load(other, other_claim) == [b"3", b"2", b"1"]


async def test_first_checkpoint_of_each_of_the_last_30_days_is_stored_beside_the_last_two(nc, clock):
    store = await open_checkpoints(nc, "a")
    claim = await store.claim(10)
    for half_day in range(80):
        clock.now_s += 43_200.0
        claim = await store.write(claim, raw(half_day, b"%d" % half_day), file_format=FORMAT)
    last_days = [b"%d" % half_day for half_day in range(78, 18, -2)]
    assert await load(store, await store.claim(10)) == [b"79", *last_days]
    assert len(await _objects(nc, 10)) == DAILY_CHECKPOINTS + 1  # the last but one is the first of its day


async def test_daily_checkpoints_make_room_for_the_last_one_on_a_full_server(tmp_path, clock):
    with running(tmp_path, partitions=1) as cluster:
        nc = await nats.connect(cluster.url)
        await make_streams(nc, partitions=1)
        store = await open_checkpoints(nc, "a")
        claim = await store.claim(0)
        for _ in range(6):
            clock.now_s += 86_400.0
            claim = await store.write(claim, raw(1, b"1" * CHECKPOINT_BYTES), file_format=FORMAT)
        js = nc.jetstream()
        states = await js.stream_info(STATES_STREAM)
        await js.update_stream(states.config, max_bytes=states.state.bytes + CHECKPOINT_BYTES // 2)
        with capture_logs() as logs, pytest.raises(APIError, match="maximum bytes exceeded"):
            await store.write(claim, raw(2, b"2" * CHECKPOINT_BYTES), file_format=FORMAT)
        assert logs[0]["removed"] == 3
        claim = await store.write(claim, raw(2, b"2" * CHECKPOINT_BYTES), file_format=FORMAT)
        assert [each[:1] for each in await load(store, claim)] == [b"2", b"1", b"1", b"1"]
        await nc.close()


async def test_daily_checkpoints_make_room_although_the_last_attempts_filled_the_disk_limit_of_the_server(
    tmp_path, clock
):
    with running(tmp_path, partitions=1, disk_bytes=24 << 20) as cluster:
        nc = await nats.connect(cluster.url)
        await make_streams(nc, partitions=1, raw_bytes=1 << 20)
        store = await open_checkpoints(nc, "a")
        claim = await store.claim(0)
        for _ in range(6):
            clock.now_s += 86_400.0
            claim = await store.write(claim, raw(1, b"1" * CHECKPOINT_BYTES), file_format=FORMAT)
        await nc.jetstream().add_stream(name="OTHER", subjects=["other"], discard="new")
        for size in (MESSAGE_BYTES, MESSAGE_BYTES // 8, MESSAGE_BYTES // 64, 256, 1):
            await _fill(nc, size)
        messages = (await nc.jetstream().stream_info("OTHER")).state.messages
        await nc.jetstream().purge_stream("OTHER", keep=messages - 2)
        written = None
        for _ in range(4):
            try:
                written = await store.write(claim, raw(2, b"2" * CHECKPOINT_BYTES), file_format=FORMAT)
            except APIError:
                claim = await store.claims.confirm(claim)
        assert written is not None
        assert (await load(store, written))[0][:1] == b"2"
        await nc.close()


async def _fill(nc: Client, size: int) -> None:
    """Publish messages of a size [bytes] until the server rejects one."""
    with suppress(APIError):
        while True:
            await nc.jetstream().publish("other", bytes(size))


async def test_claim_of_a_checkpoint_of_an_unreadable_format_fails_and_changes_nothing(nc):
    later_version, this_version = await open_checkpoints(nc, "later"), await open_checkpoints(nc, "this")
    claim = await later_version.write(await later_version.claim(11), raw(1, b"1"), file_format=FORMAT + 1)
    for _ in range(CHECKPOINTS_PER_PARTITION + 1):
        with pytest.raises(
            UnreadableFormatError, match=f"of format {FORMAT + 1}, this version reads {FORMAT - 1} and {FORMAT}"
        ):
            await this_version.claim(11)
    assert await later_version.claims.confirm(claim) == claim
    assert await load(later_version, claim) == [b"1"]


async def test_pointer_of_another_version_is_not_replaced(nc):
    bucket = await nc.jetstream().key_value(subjects.CHECKPOINTS_BUCKET)
    revision = await bucket.put("p12", b'{"worker": "later", "next": {}}')
    store = await open_checkpoints(nc, "a")
    with pytest.raises(UnreadableFormatError, match="pointer to the checkpoints is unreadable"):
        await store.claim(12)
    assert (await bucket.get("p12")).revision == revision


async def test_worker_refuses_a_partition_whose_bytes_are_of_another_format_than_its_pointer_says(nc, cluster):
    store = await open_checkpoints(nc, "later")
    data = bytearray(b"".join(PartitionCheckpoint(0, 1).chunks()))
    data[FORMAT_OFFSET] = FORMAT + 1
    await store.write(await store.claim(0), raw(1, b"an earlier checkpoint"), file_format=FORMAT)
    claim = await store.write(await store.claim(0), raw(1, bytes(data)), file_format=FORMAT)
    stop = asyncio.Event()
    async with Heartbeats(nc) as heartbeats:
        worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
        await send(nc, "p1", block("p1", 1))
        refused = (RefusedPartition(partition=0, format=FORMAT + 1),)
        await heartbeats.until(lambda last: "w" in last and last["w"].refused == refused)
        stop.set()
        await worker_task
    assert (await store.claim(0)).pointer.kept == claim.pointer.kept


async def test_worker_waits_for_streams_and_table_rows_and_continues_from_the_newest_intact_checkpoint(tmp_path):
    with running(tmp_path, partitions=1) as cluster:
        nc = await nats.connect(cluster.url)
        stop = asyncio.Event()
        with capture_logs() as logs:
            worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
            await until(lambda: any("fleet serve" in line.get("reason", "") for line in logs), lambda: logs)
            await make_streams(nc, partitions=1)
            unknown = await nc.subscribe(subjects.unknown())
            await send(nc, "p1", block("p1", 1))
            message = await unknown.next_msg(LONG_S)
            assert (message.subject, b"not in the table" in message.data) == (subjects.unknown("p1"), True)
            states = await nc.subscribe(subjects.published("p1", "state"))
            registry = await load_packs(nc, ["p1"])
            await _until_block(states, 1)  # deferred until the pack was known
            await send(nc, "p2", block("p2", 1))
            await unknown.next_msg(LONG_S)
            stop.set()
            await worker_task
        late_states = await nc.subscribe(subjects.published("p2", "state"))
        registry = await load_packs(nc, ["p1", "p2"])
        number = 1
        for damaged_count in range(3):
            number += 1
            store = await open_checkpoints(nc, "test")
            for checkpoint in (await store.claim(0)).pointer.checkpoints[:damaged_count]:
                await nc.jetstream().purge_stream(STATES_STREAM, subject=await chunk_subject(nc, checkpoint.object))
            stop = asyncio.Event()
            with capture_logs() as logs:
                worker_task = asyncio.create_task(work(Options(cluster.url, "w"), stop))
                await send(nc, "p1", block("p1", number))
                await _until_block(states, number)
                await _until_block(late_states, 1)  # although no block arrived after the pack became known
                stop.set()
                await worker_task
            # a damaged checkpoint may be logged again when the worker is fenced and starts again
            assert len({line["object"] for line in logs if "is damaged" in line["event"]}) == damaged_count
            assert any("from its beginning" in line["event"] for line in logs) == (damaged_count == 2)
        state = (await end_states(nc, registry, 1))[0].state("p1")
        assert state is not None
        assert estimates_of(state["estimator"]) == estimated(registry, "p1", number)
        await nc.close()


async def _until_block(states: Subscription, number: int) -> None:
    """Wait until the state after a block is published."""
    last_sample_s = PERIOD_S * (SAMPLES * number - 1)
    while json.loads((await states.next_msg(LONG_S)).data)["board_time_s"] < last_sample_s:
        pass
