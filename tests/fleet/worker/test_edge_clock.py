"""Edges with a wrong clock, judged by the server's time at the arrival of their blocks."""

import asyncio
import signal
import sys
import time

import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, decode, encode
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.block_order import MAX_AHEAD_S, MAX_BEHIND_S
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.pinned_consumer import parse_position
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.process.runtime import end_tasks
from tests.command_line import running_program
from tests.edge.test_edge_process import Board, write_pack_file
from tests.fleet.partition_stream import STORE_ID_NS, one_block, table
from tests.fleet.workers import Process, load_packs, send
from tests.patience import LONG_S

STORE_S = STORE_ID_NS // 10**9
"""Creation time of the edge's store [s since 1970]."""
YEAR_2040_S = 2_208_988_800
"""Beginning of the year 2040 [s since 1970]."""
DAY_S = 86_400
RUN_WITH_CLOCK = """
import sys, time
from pathlib import Path
offset_file, wall = Path(sys.argv.pop(1)), time.time
time.time = lambda: wall() + float(offset_file.read_text())
from bms_estimator.cli.main import main
main()
"""
"""Program that runs the command line with a wall clock whose error [s] is in a file."""


class EdgeWithClock:
    """Process ``edge`` whose wall clock has an error."""

    def __init__(self, folder, settings):
        self._error_file = folder / "clock-error"
        self._command = [sys.executable, "-c", RUN_WITH_CLOCK, self._error_file, "edge", settings]

    async def run(self, heartbeats, nc, *errors_s):
        """Run the edge, with each error [s] until a worker has two more blocks; then shut it down.

        Return the blocks in the stream by store and number, which the worker has then processed.
        """
        self._set(errors_s[0])
        async with running_program(*self._command, stdout=asyncio.subprocess.DEVNULL, stderr=None) as process:
            for error_s in errors_s:
                self._set(error_s)
                enough = processed(heartbeats.last) + 2
                await heartbeats.until(lambda last, enough=enough: processed(last) >= enough)
            process.send_signal(signal.SIGTERM)
            assert await asyncio.wait_for(process.wait(), LONG_S) == 0
        stored = [each async for batch in read_stream(nc, subjects.RAW_STREAM, "p.0.raw.*") for each in batch]
        decoded = [decode(each.data) for each in stored]
        blocks = {(block.store_created_ns, block.number): block for block in decoded}  # some were sent again
        await heartbeats.until(lambda last: processed(last) == len(blocks))
        return blocks

    def _set(self, error_s):
        new = self._error_file.with_suffix(".new")
        new.write_text(str(error_s))
        new.replace(self._error_file)


def processed(last):
    """Return the number of blocks in the worker's last heartbeat."""
    return last["w1"].counters.get("blocks", 0) if "w1" in last else 0


def samples_until(last_s):
    """Return the samples of a minute that end ``last_s`` after the creation of the store."""
    rows = np.zeros(60, SAMPLE)
    rows["time_s"] = last_s - 59.0 + np.arange(60)
    rows["voltage_v"], rows["current_a"], rows["temperature_c"] = 3.7, 1.0, 25.0
    return rows


def row_of_an_hour(partition, ahead_s):
    """Send two blocks whose edge is ``ahead_s`` ahead of the server, and return the row of the finished hour."""
    for number, last_s in enumerate((3000.0, 4000.0), 1):
        received_s = round(STORE_S + last_s - ahead_s)
        result = partition.process("a", one_block(samples_until(last_s), number), number, received_s)
    ((_, data),) = result.hours
    return Hour.model_validate_json(data)


@pytest.mark.parametrize(
    "ahead_s",
    [MAX_AHEAD_S, 0.0, -5 * 86_400.0, -MAX_BEHIND_S],
    ids=["ten minutes ahead", "exact", "delivered after five days", "delivered after a year"],
)
def test_clock_within_the_limits_and_late_delivery_are_no_error(ahead_s):
    partition = Partition(0, table)
    row = row_of_an_hour(partition, ahead_s)
    assert (row.clock_error_s, partition.clock_errors) == (None, {})
    assert row.received_hour == int(STORE_S + 4000.0 - ahead_s) // 3600


@pytest.mark.parametrize("lethal", [1, 2], ids=["first block", "later block"])
def test_lethal_block_of_an_edge_with_a_wrong_clock_is_skipped_and_the_hour_is_quarantined(lethal):
    partition, ahead_s = Partition(0, table), YEAR_2040_S - STORE_S
    hours, dead = [], []
    for number, last_s in enumerate((2000.0, 3000.0, 3500.0, 4000.0), 1):
        data, received_s = one_block(samples_until(last_s), number), round(STORE_S + last_s - ahead_s)
        result = partition.process("a", data, number, received_s, is_lethal=number == lethal)
        hours += result.hours
        dead += [number] if result.dead_reason else []
    ((_, row),) = hours
    assert dead == [lethal]
    assert Hour.model_validate_json(row).clock_error_s == ahead_s
    assert partition.clock_errors == {"a": ahead_s}


@pytest.mark.parametrize("ahead_s", [MAX_AHEAD_S + 1.0, -MAX_BEHIND_S - 1.0], ids=["ahead", "behind"])
def test_error_beyond_a_limit_is_in_the_row_and_names_the_pack(ahead_s):
    partition = Partition(0, table)
    assert row_of_an_hour(partition, ahead_s).clock_error_s == ahead_s
    assert partition.clock_errors == {"a": ahead_s}
    assert partition.counters["clock_ahead" if ahead_s > 0.0 else "clock_behind"] == 2


def test_hour_with_one_block_from_the_future_is_quarantined_and_the_following_hour_is_not():
    partition = Partition(0, table)
    rows = []
    for number, (last_s, ahead_s) in enumerate([(1000.0, 7200.0), (2000.0, 0.0), (4000.0, 0.0), (8000.0, 0.0)], 1):
        received_s = round(STORE_S + last_s - ahead_s)
        result = partition.process("a", one_block(samples_until(last_s), number), number, received_s)
        rows += [Hour.model_validate_json(data) for _, data in result.hours]
    assert [row.clock_error_s for row in rows] == [7200.0, None]
    assert partition.clock_errors == {}


def test_new_store_of_an_edge_whose_clock_steps_back_by_days_has_its_own_hours():
    partition = Partition(0, table)
    days_later_s, behind_s = 3 * 86_400, 2 * 86_400
    stores_s = {"old": STORE_S, "new": STORE_S + days_later_s - behind_s}
    blocks = [
        ("old", 1, 3000.0),
        ("old", 2, days_later_s - 3700.0),
        ("new", 1, 100.0),
        ("new", 2, 1000.0),
        ("new", 3, 4000.0),
    ]
    rows = []
    for sequence, (store, number, last_s) in enumerate(blocks, 1):
        received_s = round(stores_s[store] + last_s + (behind_s if store == "new" else 0))
        block = one_block(samples_until(last_s), number, stores_s[store] * 10**9)
        rows += [
            Hour.model_validate_json(data) for _, data in partition.process("a", block, sequence, received_s).hours
        ]
    first, last, behind = (int(STORE_S + s) // 3600 for s in (3000.0, days_later_s - 3700.0, days_later_s - behind_s))
    assert [(row.hour, row.samples) for row in rows] == [(first, 60), (last, 60), (behind, 120)]
    assert (partition.clock_errors, partition.counters.get("former_store", 0)) == ({}, 0)


def test_clock_error_of_an_unfinished_hour_survives_a_takeover():
    partition = Partition(0, table)
    partition.process("a", one_block(samples_until(1000.0), 1), 1, round(STORE_S + 1000.0 - 7200.0))
    restored = Partition.restore(0, table, b"".join(partition.snapshot().chunks()))
    ((_, data),) = restored.process("a", one_block(samples_until(4000.0), 2), 2, STORE_S + 4000).hours
    assert Hour.model_validate_json(data).clock_error_s == 7200.0


def test_revision_of_a_row_is_the_sequence_of_the_block_that_finished_it():
    partition = Partition(0, table)
    partition.process("a", one_block(samples_until(3000.0), 1), 7)
    ((message_id, data),) = partition.process("a", one_block(samples_until(4000.0), 2), 9).hours
    assert Hour.model_validate_json(data).revision == 9
    assert message_id.endswith(".9")


async def test_arrival_time_is_the_same_whether_a_message_is_delivered_or_read_from_the_stream(nc):
    """Workers read messages in three ways. With different times they could judge a clock at the limit differently."""
    js, messages = nc.jetstream(), 20
    for number in range(messages):
        await js.publish(subjects.raw("p1"), b"%d" % number)
    read = [each.received_s async for batch in read_stream(nc, subjects.RAW_STREAM, "p.0.raw.*") for each in batch]
    subscription = await js.pull_subscribe("p.0.raw.*", durable="test", stream=subjects.RAW_STREAM)
    delivered = await subscription.fetch(messages)
    got = [await js.get_msg(subjects.RAW_STREAM, number + 1) for number in range(messages)]
    assert len(read) == messages
    assert read == [parse_position(message.reply).received_s for message in delivered]
    assert read == [int(message.time.timestamp()) for message in got]
    assert abs(read[-1] - time.time()) < 60.0


async def test_worker_names_a_pack_in_2040_in_its_heartbeat_and_quarantines_its_hours(
    nc, cluster, heartbeats, tmp_path
):
    """The worker reads the blocks sent before its start from the stream, and receives the later ones."""
    await load_packs(nc, ["p1", "p2"])

    stores_s = {"p1": YEAR_2040_S, "p2": int(time.time()) - 86_400}

    async def send_hour(number):
        for pack, store_s in stores_s.items():
            data = encode(Block(store_s * 10**9, number, 1, time.time(), samples_until(3600.0 * number)))
            await send(nc, pack, data)

    await send_hour(1)
    await send_hour(2)
    worker = Process(tmp_path, cluster.url, "w1")
    try:
        await heartbeats.until(lambda last: "w1" in last and last["w1"].counters.get("blocks") == 4)
        await send_hour(3)
        await heartbeats.until(lambda last: last["w1"].counters.get("blocks") == 6)
        heartbeat = heartbeats.last["w1"]
        assert (heartbeat.clock_error_count, list(heartbeat.clock_errors)) == (1, ["p1"])
        assert heartbeat.clock_errors["p1"] == pytest.approx(YEAR_2040_S + 10_800 - time.time(), abs=60.0)
        assert await worker.end() == 0
        rows = {}
        stream = (await nc.jetstream().stream_info(subjects.HOURS_STREAM)).state
        for sequence in range(1, stream.last_seq + 1):
            row = Hour.model_validate_json((await nc.jetstream().get_msg(subjects.HOURS_STREAM, sequence)).data)
            rows.setdefault(row.pack, []).append(row)
    finally:
        worker.kill()
    assert [row.clock_error_s is not None for row in rows["p1"]] == [True, True]
    assert [row.clock_error_s for row in rows["p2"]] == [None, None]
    assert [row.revision for row in rows["p1"]] == [3, 5]
    assert all(abs(row.received_hour - time.time() / 3600) < 2 for row in rows["p1"] + rows["p2"])


@pytest.mark.thorough
async def test_edge_whose_clock_steps_back_by_days_loses_no_sample_and_is_not_silent(
    nc, cluster, heartbeats, tmp_path, state_home, line
):
    """The clock is 5 days behind, then correct, then 3 days behind, also after restarts: with the store and without it."""
    line.plug()
    board = asyncio.create_task(Board(line).print_lines())
    await load_packs(nc, ["pack"])
    worker = Process(tmp_path, cluster.url, "w1")
    edge = EdgeWithClock(tmp_path, write_pack_file(tmp_path, line, cluster.mqtt_port))
    try:
        await edge.run(heartbeats, nc, -5 * DAY_S, 0, -3 * DAY_S)
        await edge.run(heartbeats, nc, -3 * DAY_S)
        for file in state_home.rglob("pack.edge.sqlite*"):
            file.unlink()
        blocks = await edge.run(heartbeats, nc, -3 * DAY_S)
        heartbeat = heartbeats.last["w1"]
        assert await worker.end() == 0
    finally:
        worker.kill()
        await end_tasks(board)
    stored = [each async for batch in read_stream(nc, subjects.HOURS_STREAM, ">") for each in batch]
    rows = [Hour.model_validate_json(each.data) for each in stored]
    first_store, last_store = sorted({store for store, _ in blocks})
    assert (last_store - first_store) / 1e9 == pytest.approx(2 * DAY_S, abs=2 * LONG_S)
    lines = np.concatenate([np.round((block.samples["voltage_v"] - 3.0) * 1e4) for _, block in sorted(blocks.items())])
    assert heartbeat.counters["samples"] == lines.size
    assert np.count_nonzero(np.diff(lines) != 1.0) == 2  # the restarts
    assert (heartbeat.clock_errors, heartbeat.counters["lost_blocks"]) == ({}, 0)
    assert min(row.received_hour - row.hour for row in rows) in (
        0,
        1,
    )  # 120 only, if the earlier hour of the new store is ignored
    write(tmp_path / "rows", rows)
    assert run_query(tmp_path / "rows", "silent").rows == []
