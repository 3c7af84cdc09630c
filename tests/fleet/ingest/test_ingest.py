"""Batches that ``fleet ingest`` receives: the workers' states equal those of packs with edges."""

import asyncio
import shutil
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nats.aio.client import Client
from nats.js.errors import APIError, NoStreamResponseError
from structlog.testing import capture_logs

from bms_estimator.edge import subjects
from bms_estimator.edge.block import decode
from bms_estimator.edge.block_sender import BlockSender
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.fleet.ingest import ingest as ingest_module, telemetry_reader
from bms_estimator.fleet.ingest.batch_reports import BatchReport
from bms_estimator.fleet.ingest.batch_samples import BatchSamples, Selection
from bms_estimator.fleet.ingest.ingest_store import FILE, IngestStore
from bms_estimator.fleet.ingest.telemetry_reader import TelemetryReader
from bms_estimator.fleet.nats.dead_letters import read_dead_letters, replay_letter
from bms_estimator.fleet.nats.streams import MAX_BATCH_BYTES, make_telemetry_stream
from bms_estimator.fleet.packs.pack_bucket import remove_keys
from bms_estimator.fleet.packs.pack_registry import UNKNOWN_PACK
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.clock import Clock
from bms_estimator.settings.connections import EdgeSettings
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map
from tests.fleet.ingest.platform import (
    START_S,
    ingesting,
    json_batch,
    running_ingest,
    samples_of,
    select,
    until_stored,
)
from tests.fleet.ingest.worker_states import PARTITIONS, of_one_run, states, worker
from tests.fleet.nats_cluster import NatsCluster
from tests.fleet.workers import end_states, load_packs, until
from tests.patience import LONG_S

COUNT = 300
"""Number of samples of a pack."""
BLOCK_SAMPLES = 6
"""Number of samples of a block, which lasts a minute."""


async def send(nc: Client, pack: str, batch: bytes, wait_s: float = LONG_S) -> None:
    """Publish a batch, and wait until the server has stored it."""
    await nc.jetstream().publish(subjects.telemetry(pack), batch, timeout=wait_s)


async def send_when_stream_exists(nc: Client, pack: str, batch: bytes) -> None:
    """Publish a batch, and repeat this until the server has the stream.

    A server that is creating the stream may drop a message without a response. ingest counts no sample of a repeated batch twice.
    """
    deadline_s = time.monotonic() + LONG_S
    while True:
        try:
            return await send(nc, pack, batch, wait_s=5.0)
        except (NoStreamResponseError, TimeoutError):
            assert time.monotonic() < deadline_s


async def send_by_edge(cluster: NatsCluster, folder: Path, pack: str, rows: SampleBlock) -> None:
    """Send samples by an edge whose clock shows the time of the last sample that has arrived."""
    now_s = START_S
    settings = EdgeSettings(url=f"mqtt://127.0.0.1:{cluster.mqtt_port}", block_s=60.0)
    clock = Clock(wall=lambda: now_s)
    async with BlockSender(
        settings, pack, folder, clock=clock, steady=lambda: now_s, final_send_timeout_s=LONG_S
    ) as edge:
        for part in np.array_split(rows, 10):
            now_s = float(part["time_s"][-1])
            part["time_s"] -= START_S
            edge.take(part)
        await until(lambda: edge.queue.waiting == 0 and edge.queue.unconfirmed, edge.health)


async def test_states_of_packs_with_ingest_and_with_an_edge_are_equal(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1", "edge"])
    rows = samples_of("p1", COUNT)
    async with worker(cluster.url, 2 * COUNT), ingesting(tmp_path, cluster.url):
        await send_by_edge(cluster, tmp_path, "edge", rows.copy())
        # overlapping, repeated and unsorted batches
        for batch in (rows[:100], rows[:100], rows[50:200][::-1], np.concatenate([rows[200:], rows[200:210]])):
            await send(nc, "p1", json_batch(batch))
        await until_stored(tmp_path, COUNT // BLOCK_SAMPLES - 1)
    by_ingest, by_edge = await states(nc, registry, "p1", "edge")
    assert by_ingest == by_edge == of_one_run(registry, "p1", rows)


async def test_kill_in_the_middle_loses_no_sample_and_counts_none_twice(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1", "p2"])
    rows = {pack: samples_of(pack, COUNT) for pack in ("p1", "p2")}
    blocks = await nc.subscribe("raw.*")
    async with worker(cluster.url, 2 * COUNT):
        for part in range(0, COUNT, 150):
            async with running_ingest(tmp_path, cluster.url) as ingest:
                for pack in rows:
                    for first in range(part, part + 150, 15):
                        await send(nc, pack, json_batch(rows[pack][first : first + 15]))
                        await send(nc, pack, json_batch(rows[pack][max(first - 15, 0) : first]))
                while blocks.pending_msgs:
                    await blocks.next_msg()
                await blocks.next_msg(LONG_S)
                ingest.process.kill()
                await ingest.process.wait()
        async with running_ingest(tmp_path, cluster.url) as ingest:
            await ingest.logged("ingested")
            assert await ingest.end() == 0
    assert await states(nc, registry, *rows) == [of_one_run(registry, pack, rows[pack]) for pack in rows]


async def test_kill_of_the_server_loses_no_sample_and_counts_none_twice(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1"])
    rows = samples_of("p1", COUNT)
    async with worker(cluster.url, COUNT), ingesting(tmp_path, cluster.url):
        for first in range(0, COUNT, 60):
            await send(nc, "p1", json_batch(rows[first : first + 60]))
            cluster.kill(0)
            await asyncio.to_thread(cluster.start, 0)
            await until(lambda: nc.is_connected, lambda: "no connection")
        await until_stored(tmp_path, COUNT // BLOCK_SAMPLES - 1)
    assert await states(nc, registry, "p1") == [of_one_run(registry, "p1", rows)]


async def test_missing_block_is_sent_again_and_confirmed_blocks_are_deleted(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    await load_packs(nc, ["p1"])
    blocks = await nc.subscribe("raw.p1")
    async with ingesting(tmp_path, cluster.url):
        await send(nc, "p1", json_batch(samples_of("p1", 5 * BLOCK_SAMPLES + 1)))
        received = [decode((await blocks.next_msg(LONG_S)).data) for _ in range(5)]
        assert [block.number for block in received] == [1, 2, 3, 4, 5]
        request = BlockRequest(store=received[0].store_created_ns, number=3, resend=True)
        await nc.publish(subjects.block_request("p1"), request.model_dump_json().encode())
        resent = [decode((await blocks.next_msg(LONG_S)).data) for _ in range(3)]
        assert [block.number for block in resent] == [3, 4, 5]
    last = decode((await blocks.next_msg(LONG_S)).data)
    assert (last.number, last.oldest, last.samples.size) == (6, 3, 1)
    assert select(tmp_path, "SELECT number FROM block") == [3, 4, 5, 6]


async def test_damaged_file_is_replaced_and_later_samples_continue(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1", "p2"])
    rows = {pack: samples_of(pack, 60) for pack in ("p1", "p2")}
    garbage = tmp_path / "garbage"
    garbage.write_bytes(b"garbage" * 1000)
    blocks = await nc.subscribe("raw.*")
    async with worker(cluster.url, 120), ingesting(tmp_path, cluster.url):
        await send(nc, "p2", json_batch(rows["p2"][:30]))
        await send(nc, "p1", json_batch(rows["p1"][:30]))
        await until(lambda: select(tmp_path, "SELECT next FROM pack") == [5, 5], lambda: "not stored")
        for _ in range(2 * 4):  # only blocks that are not sent yet are lost with the file
            await blocks.next_msg(LONG_S)
        for suffix in ("-wal", "-shm"):
            (tmp_path / "blocks" / (FILE + suffix)).unlink()
        garbage.replace(tmp_path / "blocks" / FILE)
        await send(nc, "p1", json_batch(rows["p1"]))
        # the file has the position of the other pack too
        await until(lambda: select(tmp_path, "SELECT next FROM pack") == [10, 5], lambda: "not stored")
        await send(nc, "p2", json_batch(rows["p2"]))
        await until(lambda: select(tmp_path, "SELECT next FROM pack") == [10, 10], lambda: "not stored")
    assert await states(nc, registry, *rows) == [of_one_run(registry, pack, rows[pack]) for pack in rows]


async def test_second_process_waits_and_continues_after_the_last_block_of_the_stream(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    registry = await load_packs(nc, ["p1"])
    rows = samples_of("p1", 60)
    first, second = tmp_path / "first", tmp_path / "second"
    async with worker(cluster.url, 60), AsyncExitStack() as stack:
        async with ingesting(first, cluster.url):
            await send(nc, "p1", json_batch(rows[:30]))
            await until_stored(first, 4)
            with capture_logs() as lines:
                await stack.enter_async_context(ingesting(second, cluster.url))
                await until(lambda: "another `fleet ingest` runs" in str(lines), lambda: lines)
        await send(nc, "p1", json_batch(rows))  # of which the first process has sent the first half
        await until_stored(second, 4)
    partitions = await end_states(nc, registry, PARTITIONS)
    state = partitions[subjects.partition_of("p1", PARTITIONS)].state("p1")
    assert state is not None
    assert int(state["estimator"]["observer"]["samples"][0]) == 60


async def test_rejected_batch_is_reported_and_can_be_replayed(nc: Client, cluster: NatsCluster, tmp_path: Path) -> None:
    await load_packs(nc, ["p1", "p2"])
    reports = await nc.subscribe("ingest.*")
    rows = samples_of("p1", 2 * BLOCK_SAMPLES)
    batch = json_batch(rows).replace(b"voltage_v", "U_größe".encode())
    async with ingesting(tmp_path, cluster.url):
        await send(nc, "p1", batch)
        await send(nc, "ghost", batch)
        received = [BatchReport.model_validate_json((await reports.next_msg(LONG_S)).data) for _ in "12"]
    assert [report.pack for report in received] == ["p1", "ghost"]
    assert received[0].error.startswith("no column of voltage; found time_s, current_a, U_größe")
    assert received[1].error == UNKNOWN_PACK
    (letter,) = await read_dead_letters(nc)
    assert (letter.pack, letter.data, letter.reason) == ("p1", batch, received[0].error)
    column_map = parse_column_map("time=time_s,current=current_a,voltage=U_größe")
    async with ingesting(tmp_path, cluster.url, column_map=column_map):
        await replay_letter(nc, letter)
        await until_stored(tmp_path, 1)
        await remove_keys(nc, subjects.PACKS_BUCKET, ["p1"])
        await until(lambda: select(tmp_path, "SELECT next FROM pack") == [], lambda: "the pack is not removed")
        assert select(tmp_path, "SELECT number FROM block") == []


async def test_no_batch_stops_the_batches_after_it(
    nc: Client, cluster: NatsCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = IngestStore.add

    def add_all_but_seven_cells(store: IngestStore, pack: str, batch: BatchSamples, *more: Any) -> Selection:
        if batch.cells_v.shape[1] == 7:
            raise KeyError(7)
        return add(store, pack, batch, *more)

    monkeypatch.setattr(IngestStore, "add", add_all_but_seven_cells)
    await load_packs(nc, ["p1", "p2"])
    rows = samples_of("p1", 12)
    rejected = {
        json_batch(rows, cells_v=[[3.7] * 7] * 12): "internal error: KeyError in test_ingest.py, line",
        json_batch(rows, cells_v=[[[3.7]]] * 12): "cells_v: must be numbers",
        b'{"time_s": [1], "current_a": [1], "\\ud800": [1]}': r"no column of voltage; found time_s, current_a, \ud800",
        b"[" * MAX_BATCH_BYTES: "neither JSON nor Arrow IPC: maximum recursion depth exceeded",
    }
    async with ingesting(tmp_path, cluster.url):
        for batch in rejected:
            await send(nc, "p2", batch)
        await nc.jetstream().publish(subjects.telemetry("p1"), json_batch(rows), headers={"Status": "503"})
        await until(lambda: select(tmp_path, "SELECT next FROM pack") == [2], lambda: "not stored")
    letters = await read_dead_letters(nc)
    assert [letter.pack for letter in letters] == ["p2"] * len(rejected)
    for letter in letters:
        assert letter.reason.startswith(rejected[letter.data])


async def test_unknown_packs_have_one_log_line(nc: Client, cluster: NatsCluster, tmp_path: Path) -> None:
    await load_packs(nc, ["p1"])
    reports = await nc.subscribe("ingest.*")
    with capture_logs() as lines:
        async with ingesting(tmp_path, cluster.url):
            for pack in ("ghost1", "ghost2", "ghost1"):
                await send(nc, pack, json_batch(samples_of("p1", 1)))
                await reports.next_msg(LONG_S)
    (line,) = (line for line in lines if "ghost" in str(line))
    assert (line["batches"], line["packs"], line["first"]) == (3, 2, "ghost1, ghost2")


async def test_other_tasks_run_between_the_parts_of_a_batch(
    nc: Client, cluster: NatsCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await load_packs(nc, ["p1"])
    iteration, iterations, add = 0, list[int](), IngestStore.add

    def counted_add(*arguments: Any) -> Selection:
        iterations.append(iteration)
        return add(*arguments)

    monkeypatch.setattr(IngestStore, "add", counted_add)
    monkeypatch.setattr(ingest_module, "MAX_PART_SAMPLES", 10)
    async with ingesting(tmp_path, cluster.url):
        await send(nc, "p1", json_batch(samples_of("p1", 60)))
        while len(iterations) < 6:
            iteration += 1
            await asyncio.sleep(0)
    assert len(set(iterations)) == 6


async def test_damaged_stream_is_replaced_and_its_lost_batches_are_named(
    nc: Client, cluster: NatsCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ingest_module, "CHECK_S", 0.05)
    monkeypatch.setattr(telemetry_reader, "RETRY_S", 0.01)
    await load_packs(nc, ["p1"])
    for _ in range(3):
        await send(nc, "p1", json_batch(samples_of("p1", 6)))
    cluster.kill(0)
    await asyncio.to_thread(cluster.start, 0)
    # the server, which has no messages in memory, now answers each purge with error 10051
    shutil.rmtree(next(cluster.nodes[0].store.rglob("TELEMETRY")) / "msgs")
    with capture_logs() as lines:
        async with ingesting(tmp_path, cluster.url):
            await until(lambda: "deleted and created again" in str(lines), lambda: lines)
            await until(lambda: nc.is_connected, lambda: "no connection")
            await send_when_stream_exists(nc, "p1", json_batch(samples_of("p1", 12)))
            await until_stored(tmp_path, 1)
    lost = [line for line in lines if line["event"] == "the server has lost batches"]
    assert [(line["batches"], line["first"], line["last"]) for line in lost] == [(3, 1, 3)]
    errors = [line["reason"] for line in lines if line["event"] == "the server has an error in the stream of batches"]
    assert len(errors) == telemetry_reader.MAX_FAILURES
    assert all("10051" in error for error in errors)


async def test_missing_stream_is_created_again_and_later_batches_are_stored(
    nc: Client, cluster: NatsCluster, tmp_path: Path
) -> None:
    await load_packs(nc, ["p1"])
    async with ingesting(tmp_path, cluster.url):
        await send(nc, "p1", json_batch(samples_of("p1", BLOCK_SAMPLES + 1)))
        await until_stored(tmp_path, 1)
        await nc.jetstream().delete_stream(subjects.TELEMETRY_STREAM)
        await until_stored(tmp_path, 2)  # the open block, whose batch the new stream does not have
        await send_when_stream_exists(nc, "p1", json_batch(samples_of("p1", 3 * BLOCK_SAMPLES)))
        await until_stored(tmp_path, 3)


async def test_recreated_stream_is_read_from_its_beginning_and_processed_batches_are_removed(nc: Client) -> None:
    js = nc.jetstream()
    reader = TelemetryReader(nc, "", 0)
    for _ in range(3):
        await send(nc, "p1", b"batch")
    await reader.check(0)
    assert [message.sequence for message in await reader.read()] == [1, 2, 3]
    reader.sequence = 3
    await reader.check(2)
    assert (await js.stream_info(subjects.TELEMETRY_STREAM)).state.first_seq == 3
    assert await reader.read() == []
    assert await TelemetryReader(nc, "", 0).check(0) == range(0)  # without a stored position nothing counts as lost
    await js.delete_stream(subjects.TELEMETRY_STREAM)
    await make_telemetry_stream(nc, 1000)
    for _ in range(5):
        await send(nc, "p1", bytes(100))
    await reader.check(3)
    assert reader.sequence == 0
    assert len(await reader.read()) == 5
    await reader.check(0)
    assert "of the stream TELEMETRY is filled" in reader.warning
    with pytest.raises(APIError, match="maximum bytes exceeded"):
        await send(nc, "p1", bytes(1000))
