"""Table of packs on the real server: how commands write it and workers read it."""

import asyncio

import nats
import pytest

from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.nats.bucket_reader import read_bucket
from bms_estimator.fleet.nats.stream_reader import BATCH_MESSAGES, StreamError
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import (
    PackBucket,
    WriteCounts,
    purge_keys,
    put_new,
    remove_keys,
    write_bucket,
)
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from bms_estimator.model.cell import load_cell
from bms_estimator.model.pack_model import cell_text
from tests.fleet.nats_cluster import connected, running
from tests.fleet.workers import until_table
from tests.patience import LONG_S

LFP_ROW = encode_row(PackSpec(cell="lfp", capacity_ah=100.0, series=16))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with running(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture
async def nc(cluster):
    async with await connected(cluster.url) as nc:
        await make_streams(nc, partitions=1)
        for bucket in (PACKS_BUCKET, CELLS_BUCKET):
            await write_bucket(nc, bucket, {}, remove=True)
        yield nc


async def test_only_differences_are_written_and_rows_are_removed_on_request(nc):
    values = {f"p{i}": LFP_ROW for i in range(2 * BATCH_MESSAGES + 5)}
    assert await write_bucket(nc, PACKS_BUCKET, values) == WriteCounts(
        new=len(values), changed=0, same=0, removed=0, left=0
    )
    assert await read_bucket(nc, PACKS_BUCKET) == values
    other_values = {"p0": LFP_ROW, "p1": b"{}", "more": LFP_ROW}
    assert await write_bucket(nc, PACKS_BUCKET, other_values) == WriteCounts(
        new=1, changed=1, same=1, removed=0, left=len(values) - 2
    )
    assert await write_bucket(nc, PACKS_BUCKET, other_values, remove=True) == WriteCounts(
        new=0, changed=0, same=3, removed=len(values) - 2, left=0
    )
    assert await read_bucket(nc, PACKS_BUCKET) == other_values
    await remove_keys(nc, PACKS_BUCKET, ["more"])
    assert (await read_bucket(nc, PACKS_BUCKET)).keys() == {"p0", "p1"}


async def test_first_refresh_returns_all_packs_and_later_ones_return_the_changed_packs(nc):
    await write_bucket(nc, PACKS_BUCKET, {"a": LFP_ROW, "b": b"{broken", "c": encode_row(PackSpec(cell="own"))})
    bucket = PackBucket(nc)
    assert await bucket.refresh() >= {"a", "b", "c"}
    assert await bucket.refresh() == set()
    assert bucket.packs("a")
    assert bucket.packs("b") is None
    assert bucket.packs("c") is None
    assert bucket.packs.reason("b").startswith("its row is wrong: ")
    await write_bucket(nc, CELLS_BUCKET, {"own": cell_text(load_cell("ncr18650")).encode()})
    assert await bucket.refresh() == {"c"}
    assert bucket.packs("c")
    await write_bucket(nc, PACKS_BUCKET, {"b": LFP_ROW})
    await remove_keys(nc, PACKS_BUCKET, ["a"])
    assert await bucket.refresh() == {"a", "b"}
    assert bucket.packs("a") is None
    assert bucket.packs("b")


async def test_refresh_after_the_table_was_recreated_returns_the_changed_packs(nc):
    await write_bucket(nc, PACKS_BUCKET, {"a": encode_row(PackSpec(cell="own")), "b": LFP_ROW, "c": LFP_ROW})
    bucket = PackBucket(nc)
    await bucket.refresh()
    await nc.jetstream().delete_stream(f"KV_{PACKS_BUCKET}")
    await write_bucket(nc, CELLS_BUCKET, {"own": cell_text(load_cell("ncr18650")).encode()})
    with pytest.raises(StreamError, match="KV_packs: a stream is missing"):
        await bucket.refresh()
    await make_streams(nc, partitions=1)
    rows = {
        "b": b"{broken",
        "d": LFP_ROW,
        "e": LFP_ROW,
        "f": LFP_ROW,
    }  # of which three have numbers that were read before
    await write_bucket(nc, PACKS_BUCKET, rows)
    await remove_keys(nc, PACKS_BUCKET, ["c"])
    assert await bucket.refresh() == {"a", "c", *rows}
    assert bucket.packs("a")
    assert bucket.packs("b") is None
    follower = asyncio.create_task(bucket.follow(lambda _: None))
    try:  # only the lost row is written again, and neither the changed nor the removed one
        await until_table(nc, {"a": encode_row(PackSpec(cell="own")), **rows})
    finally:
        follower.cancel()


async def test_new_keys_do_not_replace_values(nc):
    await write_bucket(nc, PACKS_BUCKET, {"a": LFP_ROW, "b": LFP_ROW})
    await remove_keys(nc, PACKS_BUCKET, ["b"])
    await put_new(nc, PACKS_BUCKET, dict.fromkeys(("a", "b", "new"), b"{}"))
    assert await read_bucket(nc, PACKS_BUCKET) == {"a": LFP_ROW, "new": b"{}"}


async def test_refresh_finds_that_a_row_was_purged_with_the_mark_of_its_removal(nc):
    await write_bucket(nc, PACKS_BUCKET, {"a": LFP_ROW, "b": LFP_ROW})
    bucket = PackBucket(nc)
    await bucket.refresh()
    await purge_keys(nc, PACKS_BUCKET, ["a"])
    assert await bucket.refresh() == {"a"}
    assert list(bucket.packs) == ["b"]
    assert await bucket.refresh() == set()


async def test_follow_continues_after_the_server_was_killed(cluster, nc):
    changes = asyncio.Queue()
    bucket = PackBucket(nc)
    await bucket.refresh()
    follower = asyncio.create_task(bucket.follow(changes.put_nowait))
    try:
        await write_bucket(nc, PACKS_BUCKET, {"a": LFP_ROW})
        assert await asyncio.wait_for(changes.get(), LONG_S) == {"a"}
        cluster.kill(0)
        cluster.start(0)
        async with await nats.connect(cluster.url) as other:
            await write_bucket(other, PACKS_BUCKET, {"b": LFP_ROW})
        assert await asyncio.wait_for(changes.get(), LONG_S) == {"b"}
        assert bucket.packs("b")
    finally:
        follower.cancel()


async def test_reading_from_a_server_without_streams_raises_an_error(tmp_path):
    with running(tmp_path) as cluster:
        async with await nats.connect(cluster.url) as nc:
            with pytest.raises(StreamError, match="rejects reading KV_packs"):
                await read_bucket(nc, PACKS_BUCKET)
