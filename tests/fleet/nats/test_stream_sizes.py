"""Sizes of a day of simulated packs on the real server, from which the sizes of the streams are computed."""

import sys
import time
from dataclasses import replace
from pathlib import Path

import nats
import numpy as np
import pytest

from bms_estimator.edge import subjects
from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.nats.stream_sizes import (
    BLOCK_BYTES,
    CELL_STATE_BYTES,
    DAILY_STATE_BYTES,
    DAY_BLOCKS,
    HOUR_ROW_BYTES,
    STATE_BYTES,
    block_bytes,
    stream_sizes,
)
from bms_estimator.fleet.nats.streams import HOURS_FRACTION, make_streams
from bms_estimator.fleet.packs.csv_table import read_table
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.server.disk_space import sizes_of
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, SimulatedFleet
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import NO_CELLS
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.fleet import FleetSettings, ServerSettings, TenantSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank
from tests.fleet.nats_cluster import running

PACKS = 2


@pytest.mark.thorough
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
                for message_id, hour in partition.process(fleet.names[i], data, partition.sequence + 1).hours:
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


@pytest.mark.parametrize("cells", [4, 16, 66, 100])
def test_block_hour_and_state_with_cell_voltages_are_at_most_as_large_as_computed(cells: int) -> None:
    rng, cell = np.random.default_rng(1), load_cell("nmc", 50.0)
    bank, model = SimulatedBank(cell, BankCells.random(rng, cells, 50.0, 0.8)), cell.pack(cells, 1)
    settings, store_ns = Settings(), 490_000 * 3600 * 10**9
    partition, sizes, hours, additional = Partition(0, lambda _: (settings, model)), [], [], []
    for number in range(1, 62):
        history = bank.run(np.round(10.0 + 5.0 * rng.standard_normal(60), 2))
        cells_v = np.round(history.cell_v + 5e-4 * rng.standard_normal(history.cell_v.shape), 3)
        samples = history.samples(rng, 2e-3, 1e-2)
        block = Block(store_ns, number, 1, store_ns / 1e9 + 60.0 * number, samples, cells_v)
        data, without_cells = encode(block), encode(replace(block, cells_v=NO_CELLS))
        hours += partition.process("with", data, 2 * number - 1).hours
        partition.process("without", without_cells, 2 * number)
        sizes.append(len(data))
        additional.append(len(data) - len(without_cells))
    snapshot = partition.snapshot()
    state_bytes = (len(snapshot.other_layouts["with"].packed) - len(snapshot.packs["without"])) / cells
    ((_, hour),) = hours
    sys.stdout.write(
        f"{cells} cells: block {np.mean(sizes):.0f}, of these {np.mean(additional):.0f} for the cells, "
        f"hourly summary {len(hour)}, state {state_bytes:.0f} for each cell\n"
    )
    assert 0.4 * (block_bytes(cells) - BLOCK_BYTES) < np.mean(additional) <= block_bytes(cells) - BLOCK_BYTES
    assert HOURS_FRACTION * 60 * block_bytes(cells) > 1.5 * len(hour)
    assert 0.5 * CELL_STATE_BYTES < state_bytes <= CELL_STATE_BYTES


@pytest.mark.parametrize("packs", [1, 1000, 100_000])
@pytest.mark.parametrize("days", [0.5, 7.0, 30.0])
@pytest.mark.parametrize("cells", [0, 16])
@pytest.mark.parametrize("block_s", [10.0, 60.0])
def test_streams_hold_the_outage_for_any_number_of_packs(packs: int, days: float, cells: int, block_s: float) -> None:
    sizes = stream_sizes(packs, days, cells, block_s)
    assert sizes.raw >= packs * days * DAY_BLOCKS * block_bytes(cells)
    assert sizes.states >= packs * (STATE_BYTES + cells * CELL_STATE_BYTES)
    assert HOURS_FRACTION * sizes.raw >= packs * days * 24 * HOUR_ROW_BYTES
    assert sizes.pack_blocks >= days * 86_400 / block_s


@pytest.mark.parametrize(("tenant_cells", "cells"), [(None, 16), (0, 0), (4, 4)])
def test_cells_of_a_tenant_replace_those_of_the_server(tenant_cells: int | None, cells: int) -> None:
    settings = FleetSettings(server=ServerSettings(packs=100_000, cells=16))
    assert sizes_of(settings, TenantSettings(cells=tenant_cells)) == stream_sizes(100_000, 7.0, cells)
