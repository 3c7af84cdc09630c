"""Stream that overflows while no worker runs, and a damaged last checkpoint: the edges resend all missing blocks."""

import asyncio
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats import unsaved_blocks as unsaved_module
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, CheckpointPointer, pointer_key
from bms_estimator.fleet.nats.streams import RAW_BYTES, make_streams
from bms_estimator.fleet.nats.unsaved_blocks import unsaved_blocks
from bms_estimator.fleet.packs.csv_table import read_table
from bms_estimator.fleet.packs.pack_bucket import PackBucket, write_bucket
from bms_estimator.fleet.simulation.block_publisher import run_edges
from bms_estimator.fleet.simulation.simulated_edges import SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.fleet.worker import worker as worker_module
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import open_checkpoints
from bms_estimator.settings.connections import MqttSettings
from tests.command_line import run
from tests.fleet.checkpoints import damage
from tests.fleet.nats_cluster import connected, running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.workers import Heartbeats, Process, end_states, until
from tests.patience import LONG_S

PACKS, PARTITIONS = 2, 1
BLOCKS_PER_S = 20.0
"""Rate of the blocks of all edges [1/s]."""
SAVED, OVERFLOW, AFTERWARDS = 12, 10, 6
"""Numbers of blocks of each edge: before the first checkpoint, without a worker, and with the next worker."""
SMALL_BYTES = 4096
"""Size of the stream while it overflows [bytes]: a few blocks."""
CHECKPOINT_S = 1
"""Checkpoint interval of the workers [s]."""


@pytest.mark.thorough
async def test_no_block_is_lost_if_the_stream_overflows_without_a_worker_and_the_last_checkpoint_is_damaged(
    tmp_path: Path,
) -> None:
    with running(tmp_path, 1, partitions=PARTITIONS) as cluster, ExitStack() as stack:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=PARTITIONS)
        fleet = SimulatedFleet(PACKS, seed=1, begin_ns=time.time_ns() - 86_400 * 10**9)  # the packs are fast
        (tmp_path / "packs.csv").write_text(fleet.table())
        rows = {pack: row.data for pack, row in read_table(tmp_path / "packs.csv").packs.items()}
        await write_bucket(nc, subjects.PACKS_BUCKET, rows)
        bucket = PackBucket(nc)
        await bucket.refresh()

        def start_worker(name: str) -> Process:
            worker = Process(tmp_path, cluster.url, name, "--checkpoint-s", CHECKPOINT_S)
            stack.callback(worker.kill)
            return worker

        async def until_processed(heartbeats: Heartbeats, name: str, blocks: int) -> None:
            """Wait until the partition has processed or lost a number of blocks of each edge."""

            def is_processed(last: Mapping[str, Heartbeat]) -> bool:
                counters = last[name].counters if name in last else {}
                return counters.get("blocks", 0) + counters.get("lost_blocks", 0) >= PACKS * blocks

            await heartbeats.until(is_processed)

        edges = SimulatedEdges(fleet, start_s=time.time(), speed=BLOCKS_PER_S * BLOCK_S / PACKS, last=SAVED)
        settings, stop = MqttSettings(url=(f"mqtt://127.0.0.1:{cluster.mqtt_port}",)), asyncio.Event()
        publisher = asyncio.create_task(
            run_edges(fleet, edges, settings, connections=1, stop=stop, report=lambda _: None, quiet_s=LONG_S)
        )
        async with Heartbeats(nc) as heartbeats:
            saving_worker = start_worker("saving")
            await until_processed(heartbeats, "saving", SAVED)
            assert await saving_worker.end() == 0
            killed_worker = start_worker("killed")
            await heartbeats.until_held(PARTITIONS, "killed")
            edges.last = None
            await until(lambda: edges.confirmed_below.min() > SAVED, lambda: edges.confirmed_below)
            killed_worker.kill()
            await make_streams(nc, partitions=PARTITIONS, raw_bytes=SMALL_BYTES)
            edges.last = int(edges.next_number.max()) + OVERFLOW
            await until(lambda: edges.done, lambda: edges.next_number)
            store = await open_checkpoints(nc, "test")
            last, previous = (await store.claim(0)).pointer.kept
            await damage(nc, last.object)
            js = nc.jetstream()
            while (state := (await js.stream_info(subjects.RAW_STREAM)).state).first_seq <= last.sequence:  # noqa: ASYNC110 - the stream has no notifications
                await asyncio.sleep(0.02)
            assert previous.sequence < last.sequence < state.first_seq
            await make_streams(nc, partitions=PARTITIONS, raw_bytes=RAW_BYTES)
            next_worker = start_worker("next")
            await heartbeats.until_held(PARTITIONS, "next")
            edges.last += AFTERWARDS
            await until_processed(heartbeats, "next", edges.last)
        stop.set()
        await publisher
        assert await next_worker.end() == 0
        partition = (await end_states(nc, bucket.packs, PARTITIONS))[0]
        for i, pack in enumerate(fleet.names):
            state = partition.state(pack)
            assert state is not None
            assert (state["delivery"]["awaited"][0], state["delivery"]["lost_blocks"][0]) == (edges.last + 1, 0)
            estimator = make_estimator(*bucket.packs(pack))
            for samples in fleet.samples(np.full(edges.last, i), np.arange(1, edges.last + 1)):
                estimator.run(samples)
            assert estimates_of(state["estimator"]) == estimates_of(estimator.record)
        await nc.close()


async def test_status_and_heartbeats_warn_when_unsaved_blocks_fill_half_of_the_stream(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_module, "UNSAVED_CHECK_S", 0.1)
    with running(tmp_path, 1, partitions=PARTITIONS) as cluster:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=PARTITIONS, raw_bytes=1 << 20)
        js = nc.jetstream()
        data = bytes(100 << 10)
        warnings = []
        for messages in (5, 1):
            for _ in range(messages):
                await js.publish(subjects.raw("p1"), data)
            code, out, _ = await asyncio.to_thread(run, capsys, "fleet", "status", "--server", cluster.url)
            assert code == 0
            warnings.append(" of the stream RAW are blocks that no checkpoint includes" in out)
        assert warnings == [False, True]
        stop = asyncio.Event()
        work = asyncio.create_task(worker_module.work(worker_module.Options(cluster.url, "w"), stop))
        async with Heartbeats(nc) as heartbeats:
            await heartbeats.until(lambda last: "w" in last and "no checkpoint includes" in last["w"].trouble)
            await heartbeats.until(lambda last: last["w"].unsaved_s > 0.0)
        stop.set()
        await work
        pointer = CheckpointPointer(kept=(CheckpointInfo(sequence=3, object="p0.1", bytes=1, made_s=1.79e9),))
        bucket = await js.key_value(subjects.CHECKPOINTS_BUCKET)
        await bucket.put(pointer_key(0), pointer.model_dump_json().encode())
        share = (await unsaved_blocks(nc, range(PARTITIONS))).share
        assert share == pytest.approx(0.3, abs=0.01)
        await nc.close()


async def test_blocks_that_the_limit_of_one_pack_drops_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unsaved_module, "MIN_BLOCK_S", 0.0)  # the blocks of this test have no duration
    with running(tmp_path, 1, partitions=PARTITIONS) as cluster:
        nc = await connected(cluster.urls)
        await make_streams(nc, partitions=PARTITIONS, max_pack_blocks=10)
        js = nc.jetstream()
        for number in range(15):
            await js.publish(subjects.raw("often"), b"%d" % number)
        await js.publish(subjects.raw("seldom"), b"0")
        bucket = await js.key_value(subjects.CHECKPOINTS_BUCKET)
        for sequence, has_dropped in ((3, True), (15, False)):
            pointer = CheckpointPointer(
                kept=(CheckpointInfo(sequence=sequence, object="p0.1", bytes=1, made_s=1.79e9),)
            )
            await bucket.put(pointer_key(0), pointer.model_dump_json().encode())
            warning = (await unsaved_blocks(nc, range(PARTITIONS))).warning
            assert ("stores 10 blocks of a pack, has dropped blocks of often" in warning) == has_dropped
        await nc.close()
