"""``fleet capture`` of blocks that edges have sent to the real server over MQTT."""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime

import aiomqtt
import nats
import numpy as np
import pytest

from bms_estimator.edge.block import encode
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import NO_CELLS
from bms_estimator.sources.captures.replay import Replay, load_capture, open_capture
from tests.command_line import run
from tests.fleet.nats.test_block_capture import STORE_ID_NS, encoded_block, samples
from tests.fleet.nats_cluster import running
from tests.fleet.partition_stream import estimates_of
from tests.fleet.worker.test_single_cells import MODEL, SETTINGS, minutes, table
from tests.patience import LONG_S

CELL_BLOCKS = [encode(replace(block, cells_v=NO_CELLS) if block.number in (1, 4) else block) for block in minutes(3, 6)]
"""Blocks with cell voltages, two of which have none."""


async def send_blocks(cluster):
    """Send blocks of two packs. Block 5 is missing, 4 comes before 3 and again after it, and one message is no block."""
    async with await nats.connect(cluster.url) as nc:
        await make_streams(nc)
    async with aiomqtt.Client("127.0.0.1", cluster.mqtt_port, timeout=LONG_S) as client:
        for number in (1, 2, 4, 3, 4, 6):
            await client.publish("raw/house", encoded_block(number), qos=1)
            await client.publish("raw/other", encoded_block(number), qos=1)
        await client.publish("raw/house", b"no block", qos=1)
        for data in CELL_BLOCKS:
            await client.publish("raw/cells", data, qos=1)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with running(tmp_path_factory.mktemp("cluster")) as cluster:
        asyncio.run(send_blocks(cluster))
        yield cluster


@pytest.mark.parametrize("name", ["out.parquet", "out.csv.gz"])
def test_capture_has_each_block_once_in_order(cluster, tmp_path, capsys, name):
    out = tmp_path / name
    code, stdout, err = run(capsys, "fleet", "capture", "house", out, "--server", cluster.url)
    assert (code, stdout) == (
        0,
        f"{out}: 300 samples in 5 blocks of house, 2023-11-14T22:14:20.000Z to 2023-11-14T22:20:19.000Z\n",
    )
    assert err.splitlines() == [
        "warning: house: missing blocks: 5; they are lost, or the edge has yet to send them again",
        "warning: house: damaged messages, which were skipped: 1",
    ]
    expected = np.concatenate([samples(60.0, 240), samples(360.0)])  # blocks 1 to 4, and 6
    capture = load_capture(out)
    for column in ("time_s", "current_a", "voltage_v", "temperature_c"):
        assert (capture[column] == expected[column]).all()
    assert "exists already" in run(capsys, "fleet", "capture", "house", out, "--server", cluster.url)[2]


def test_time_span_is_limited_and_missing_samples_are_reported(cluster, tmp_path, capsys):
    out = tmp_path / "out.csv"
    first = datetime.fromtimestamp(STORE_ID_NS * 1e-9 - 3600.0, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    last = datetime.fromtimestamp(STORE_ID_NS * 1e-9 + 100.0, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    arguments = ["fleet", "capture", "house", out, "--from", first, "--to", last, "--server", cluster.url]
    code, stdout, err = run(capsys, *arguments)
    assert (code, stdout.startswith(f"{out}: 40 samples in 1 block of house")) == (0, True)
    assert "the stored samples begin at 2023-11-14T22:14:20.000Z" in err
    code, _, err = run(capsys, "fleet", "capture", "nobody", tmp_path / "no.csv", "--server", cluster.url)
    assert (code, "nobody: the server has no samples of this pack in this period" in err) == (2, True)
    assert "must end in" in run(capsys, "fleet", "capture", "house", tmp_path / "no.xls", "--server", cluster.url)[2]


@pytest.mark.parametrize("name", ["cells.parquet", "cells.csv.gz"])
async def test_replay_of_captured_cell_voltages_gives_the_states_of_the_worker_bit_for_bit(
    cluster, tmp_path, capsys, name
):
    out = tmp_path / name
    code, *_ = await asyncio.to_thread(run, capsys, "fleet", "capture", "cells", out, "--server", cluster.url)
    assert code == 0
    estimator = make_estimator(SETTINGS, MODEL)
    cells = CellEstimator(estimator)
    async for received in Replay(open_capture(out)):
        cells.run(received.samples, received.cells_v, estimator.run(received.samples))
    partition = Partition(0, table)
    for sequence, data in enumerate(CELL_BLOCKS, 1):
        partition.process("cells", data, sequence)
    assert partition.cells("cells").tobytes() == cells.cells.tobytes()
    assert estimates_of(partition.state("cells")["estimator"]) == estimates_of(estimator.record)
