"""Sizes of a day of simulated packs on the real server, from which the sizes of the streams are computed."""

import sys
import time
from pathlib import Path

import nats
import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stream_sizes import (
    BLOCK_BYTES,
    DAILY_STATE_BYTES,
    DAY_BLOCKS,
    HOUR_ROW_BYTES,
    STATE_BYTES,
    stream_sizes,
)
from bms_estimator.fleet.nats.streams import HOURS_FRACTION, make_streams, pack_blocks
from bms_estimator.fleet.packs.csv_table import read_table
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.fleet.worker.partition import Partition
from tests.fleet.nats_cluster import running

PACKS = 4


async def test_stored_day_of_a_pack_is_at_most_as_large_as_computed(tmp_path: Path) -> None:
    begin_s = time.time() // 3600 * 3600 - 2 * 86_400
    fleet, table = SimulatedFleet(PACKS, seed=1, begin_ns=int(begin_s) * 10**9), tmp_path / "packs.csv"
    table.write_text(fleet.table())
    registry = PackRegistry()
    for pack, row in read_table(table).packs.items():
        registry.set_row(pack, row.data)
    partition, largest_state = Partition(0, registry), 0.0
    with running(tmp_path, partitions=1) as cluster:
        nc = await nats.connect(cluster.url)
        js = nc.jetstream()
        await make_streams(nc, partitions=1)
        for number in range(1, DAY_BLOCKS + 1):
            numbers = np.full(PACKS, number)
            for i, data in enumerate(fleet.blocks(np.arange(PACKS), numbers, begin_s + numbers * BLOCK_S)):
                await nc.publish(subjects.raw(fleet.names[i]), data)
                for message_id, hour in partition.take(fleet.names[i], data, partition.sequence + 1).hours:
                    headers = {"Nats-Msg-Id": message_id}
                    await js.publish(subjects.hours(fleet.names[i]), hour, headers=headers)
            if number % 60 == 0:
                state_bytes = sum(map(len, partition.snapshot().chunks())) / PACKS
                largest_state = max(largest_state, state_bytes)
        await nc.flush()
        raw = (await js.stream_info(subjects.RAW_STREAM)).state
        hours = (await js.stream_info(subjects.HOURS_STREAM)).state
        await nc.close()
    block_bytes, hour_bytes = raw.bytes / raw.messages, hours.bytes / hours.messages
    sys.stdout.write(
        f"block {block_bytes:.0f}, hourly summary {hour_bytes:.0f}, "
        f"state {largest_state:.0f}, after a day {state_bytes:.0f} bytes\n"
    )
    assert 0.5 * BLOCK_BYTES < block_bytes <= BLOCK_BYTES
    assert 0.5 * HOUR_ROW_BYTES < hour_bytes <= HOUR_ROW_BYTES
    assert 0.5 * STATE_BYTES < largest_state <= STATE_BYTES
    assert 0.5 * DAILY_STATE_BYTES < state_bytes <= 1.2 * DAILY_STATE_BYTES


@pytest.mark.parametrize("packs", [1, 1000, 100_000])
@pytest.mark.parametrize("days", [0.5, 7.0, 30.0])
def test_streams_hold_the_outage_for_any_number_of_packs(packs: int, days: float) -> None:
    sizes = stream_sizes(packs, days)
    assert sizes.raw >= packs * days * DAY_BLOCKS * BLOCK_BYTES
    assert HOURS_FRACTION * sizes.raw >= packs * days * 24 * HOUR_ROW_BYTES
    assert pack_blocks(sizes.raw) >= days * DAY_BLOCKS
