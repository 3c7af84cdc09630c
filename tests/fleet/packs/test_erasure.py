"""``fleet packs remove --erase`` on the real server with a running worker.

The names of the packs are long, because a binary checkpoint contains a short one by chance.
"""

import asyncio

import nats
import pytest

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.queries.collector import only_collector
from bms_estimator.fleet.queries.duckdb_queries import run_query, select
from bms_estimator.fleet.queries.parquet_files import write
from tests.command_line import run
from tests.fleet.hour_rows import BEGIN, make_hour
from tests.fleet.nats_cluster import connected, running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import STORE_ID_NS, Heartbeats, Process, end_states, estimated, load_packs, samples, send
from tests.patience import LONG_S

BLOCKS = 8
"""Number of blocks of each pack, which last 80 minutes."""
STREAMS = (
    subjects.RAW_STREAM,
    subjects.HOURS_STREAM,
    subjects.HISTORY_STREAM,
    subjects.FITS_STREAM,
    f"OBJ_{subjects.STATES_BUCKET}",
    f"KV_{subjects.PACKS_BUCKET}",
)


def block(pack, number):
    return encode(Block(STORE_ID_NS, number, 1, STORE_ID_NS / 1e9, samples(pack, number)))


async def occurrences(nc, pack):
    """Return the streams with a message that contains the pack's name."""
    js, found = nc.jetstream(), []
    for stream in STREAMS:
        state = (await js.stream_info(stream)).state
        for sequence in range(max(state.first_seq, 1), state.last_seq + 1):
            try:
                message = await js.get_msg(stream, sequence)
            except nats.js.errors.NotFoundError:
                continue
            if pack in message.subject or pack.encode() in (message.data or b""):
                found.append(stream)
    return sorted(set(found))


@pytest.mark.thorough
async def test_erased_pack_is_in_no_stream_checkpoint_and_memory_and_the_other_pack_keeps_its_state(tmp_path, capsys):
    with running(tmp_path, partitions=1) as cluster:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=1)
        registry = await load_packs(nc, ["p00001", "p00002"])
        worker = Process(tmp_path, cluster.url, "w1", "--checkpoint-s", 1)
        try:
            async with Heartbeats(nc) as heartbeats:
                for number in range(1, BLOCKS):
                    for pack in ("p00001", "p00002"):
                        await send(nc, pack, block(pack, number))
                blocks = 2 * (BLOCKS - 1)
                await heartbeats.until(lambda last: "w1" in last and last["w1"].counters.get("blocks") == blocks)
                async with asyncio.timeout(LONG_S):
                    while len(await occurrences(nc, "p00001")) < len(STREAMS):  # noqa: ASYNC110 - streams send no notification
                        await asyncio.sleep(0.05)
                command = ("fleet", "packs", "remove", "p00001", "--erase", "--server", cluster.url)
                code, out, err = await asyncio.to_thread(run, capsys, *command)
                assert (code, err) == (0, "")
                assert out.startswith(
                    f"p00001: {BLOCKS - 1} blocks, 0 dead letters, 1 hourly summary and the state in "
                )
                assert "0 checkpoints" not in out
                assert "remaining:\n  their rows in the Parquet files" in out
                assert await occurrences(nc, "p00001") == []
                await send(nc, "p00002", block("p00002", BLOCKS))
                await heartbeats.until(lambda last: last["w1"].packs == 1)
                await heartbeats.until(lambda last: last["w1"].counters.get("blocks") == blocks + 1)
            assert await worker.end() == 0
        finally:
            worker.kill()
        assert await occurrences(nc, "p00001") == []
        partition = (await end_states(nc, registry, 1))[0]
        assert partition.state("p00001") is None
        state = partition.state("p00002")
        assert estimates_of(state["estimator"]) == estimated(registry, "p00002", BLOCKS)
        await nc.close()
        cluster.kill(0)
        assert files_with(tmp_path, subjects.stored_raw(0, "p00002"))
        assert files_with(tmp_path, subjects.stored_raw(0, "p00001")) == []
        assert files_with(tmp_path, subjects.hours("p00001")) == []


@pytest.mark.thorough
@pytest.mark.parametrize("has_worker", [True, False], ids=["with a worker", "without a worker"])
async def test_pack_that_is_added_again_after_its_erasure_begins_anew(
    nc, cluster, heartbeats, tmp_path, capsys, has_worker
):
    await load_packs(nc, ["p00001", "p00002"])
    worker = Process(tmp_path, cluster.url, "w1")
    try:
        await send(nc, "p00001", block("p00001", 1))
        await send(nc, "p00001", b"not a block")
        await send(nc, "p00002", block("p00002", 1))
        await heartbeats.until(lambda last: "w1" in last and last["w1"].packs == 2)
        await heartbeats.until(lambda last: last["w1"].dead_letters == 1)
        if not has_worker:
            assert await worker.end() == 0
        command = ("fleet", "packs", "remove", "p00001", "--erase", "--server", cluster.url)
        code, out, err = await asyncio.to_thread(run, capsys, *command)
        assert (code, err) == (0, "")
        assert out.startswith("p00001: 2 blocks, 1 dead letter,")
        if not has_worker:
            worker = Process(tmp_path, cluster.url, "w1")
        heartbeats.clear()
        await heartbeats.until(lambda last: "w1" in last and last["w1"].packs == 1)
        assert "p00001" not in heartbeats.last["w1"].model_dump_json()
        registry = await load_packs(nc, ["p00001"])
        for number in range(1, BLOCKS):  # the edge sends its stored blocks again, with the former numbers
            await nc.jetstream().publish(subjects.raw("p00001"), block("p00001", number))
        await heartbeats.until(lambda last: last["w1"].packs == 2)
        await heartbeats.until(lambda last: last["w1"].counters.get("blocks", 0) >= BLOCKS)
        assert await worker.end() == 0
    finally:
        worker.kill()
    state = (await end_states(nc, registry, 1))[0].state("p00001")
    assert estimates_of(state["estimator"]) == estimated(registry, "p00001", BLOCKS - 1)
    hours = (await nc.jetstream().stream_info(subjects.HOURS_STREAM, subjects_filter=subjects.hours("p00001"))).state
    assert hours.subjects == {subjects.hours("p00001"): 1}


def files_with(folder, text):
    """Return the files of messages on the server's disk that contain ``text``."""
    return [file for file in folder.rglob("*.blk") if text.encode() in file.read_bytes()]


async def test_pack_without_a_worker_is_erased_and_messages_in_other_streams_are_reported(nc, cluster, capsys):
    await nc.jetstream().add_stream(name="REJECTED", subjects=["rejected.*.*"])
    await nc.jetstream().publish("rejected.p00001.damaged", b"damaged")
    await send(nc, "p00001", block("p00001", 1))
    command = ("fleet", "packs", "remove", "p00001", "--erase", "--server", cluster.url)
    code, out, err = await asyncio.to_thread(run, capsys, *command)
    assert (code, err) == (0, "")
    assert out.startswith("p00001: 1 block, 0 dead letters, 0 hourly summaries and the state in 0 checkpoints erased\n")
    assert "p00001: remaining messages in the stream REJECTED: 1\n" in out


@pytest.fixture
def folder(tmp_path):
    """Return a folder whose files have rows of two packs, and one quarantined row of each."""
    packs, folder = ("p00001", "p00002"), tmp_path / "hours"
    write(folder, [make_hour(pack, BEGIN + n, received_hour=BEGIN + n + 1) for pack in packs for n in range(30)])
    write(folder, [make_hour(pack, 5, received_hour=BEGIN, revision=1, clock_error_s=-4e8) for pack in packs])
    return folder


def test_rows_are_erased_from_the_files_while_no_collector_runs(tmp_path, folder, capsys):
    with running(tmp_path, partitions=1) as cluster:

        async def create_streams():
            async with await nats.connect(cluster.url) as nc:
                await make_streams(nc, partitions=1)

        asyncio.run(create_streams())
        command = ("fleet", "packs", "remove", "p00001", "--erase", "--folder", folder, "--server", cluster.url)
        with only_collector(folder):
            code, _, err = run(capsys, *command)
            assert (code, "another collector writes there" in err) == (75, True)
        code, out, err = run(capsys, *command)
    assert (code, err) == (0, "")
    assert f"{folder}: 31 rows erased\n" in out
    assert select(folder, "SELECT pack, count(*) FROM hours GROUP BY pack").rows == [("p00002", 30)]
    assert [row["pack"] for row in run_query(folder, "clocks").records] == ["p00002"]
    assert not any(b"p00001" in file.read_bytes() for file in folder.rglob("*.parquet"))
