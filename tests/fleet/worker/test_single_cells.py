"""Estimators of single cells in a worker: as in ``replay``, over takeovers, versions and packs without cell voltages."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.edge.block import Block, decode, encode
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.worker import pack_records
from bms_estimator.fleet.worker.pack_records import CURRENT_LAYOUT, cell_count, cell_layout
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import NO_CELLS
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import assemble
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank
from bms_estimator.telemetry.cells import single_cell_fields
from bms_estimator.telemetry.publish_window import ChargeEnergy, ChargeEnergyMeter, Window
from bms_estimator.telemetry.state import FORECAST_FIELDS, make_state_payload, remaining_capacity_ah
from tests.fleet.partition_stream import STORE_ID_NS, estimates_of

CELLS, CAPACITY_AH, WEAK = 4, 20.0, 2
MINUTES = 70
PACKS = ("a", "b")
CELL = load_cell("nmc", CAPACITY_AH)
MODEL = CELL.pack(CELLS, 1)
SETTINGS = Settings(pack=PackSettings(cell="nmc", capacity_ah=CAPACITY_AH, series=CELLS))


def table(_pack):
    return SETTINGS, MODEL


def minutes(seed, count=MINUTES):
    """Return a block of each minute of a simulated pack with a weak cell."""
    rng = np.random.default_rng(seed)
    drawn = BankCells.random(rng, CELLS, CAPACITY_AH, 0.8).with_weak_cell(WEAK, soc_below=0.1)
    bank, blocks = SimulatedBank(CELL, drawn), []
    for number in range(1, count + 1):
        history = bank.run(CAPACITY_AH * 0.2 * (1.0 + 0.5 * np.sin(np.arange(60.0) / 7.0)))
        samples, cells_v = history.samples(rng, 2e-3), np.round(history.cell_v, 3)
        arrival_s = STORE_ID_NS / 1e9 + float(samples["time_s"][-1])
        blocks.append(Block(STORE_ID_NS, number, 1, arrival_s, samples, cells_v))
    return blocks


@pytest.fixture(scope="module")
def blocks():
    """Return the blocks of each pack; some of pack a have no cell voltages, or those of fewer cells."""
    of_pack = {pack: minutes(seed) for seed, pack in enumerate(PACKS)}
    for index, cells in ((0, 0), (5, 0), (9, CELLS - 1), (10, 0)):
        block = of_pack["a"][index]
        of_pack["a"][index] = replace(block, cells_v=block.cells_v[:, :cells] if cells else NO_CELLS)
    of_pack["b"][3].cells_v[7] = math.nan
    of_pack["b"][4].cells_v[:, 1] = math.nan
    return of_pack


def run(partition, blocks, *, take_over=False):
    """Process the blocks of all packs in turn. Return the partition and all results."""
    results, sequence = [], 0
    for row in zip(*blocks.values(), strict=True):
        for pack, block in zip(blocks, row, strict=True):
            sequence += 1
            results.append(partition.process(pack, encode(block), sequence))
        if take_over:
            partition = restored(partition)
    return partition, results


def restored(partition):
    return Partition.restore(0, table, b"".join(partition.snapshot().chunks()))


def replayed(blocks):
    """Return the estimators of the pack and of its cells after a replay of all samples, as ``fleet capture`` writes them."""
    samples = np.concatenate([block.samples for block in blocks])
    cells_v = np.concatenate(
        [
            block.cells_v if block.cells_v.shape[1] == CELLS else np.full((block.samples.size, CELLS), math.nan)
            for block in (decode(encode(block)) for block in blocks)
        ]
    )
    estimator = make_estimator(SETTINGS, MODEL)
    cells = CellEstimator(estimator)
    cells.run(samples, cells_v, estimator.run(samples))
    return estimator, cells


@pytest.mark.parametrize("take_over", [False, True])
def test_states_of_cells_are_bit_identical_to_those_of_a_replay(blocks, take_over):
    partition, _ = run(Partition(0, table), blocks, take_over=take_over)
    for pack in PACKS:
        estimator, cells = replayed(blocks[pack])
        assert cells.bank["windows"][0] > 0
        assert partition.cells(pack).tobytes() == cells.cells.tobytes()
        assert estimates_of(partition.state(pack)["estimator"]) == estimates_of(estimator.record)


def test_worker_publishes_the_weakest_cell_with_each_block_and_all_cells_once_an_hour(blocks):
    _, results = run(Partition(0, table), {"b": blocks["b"]})
    state = json.loads(results[-1].state)
    _, cells = replayed(blocks["b"])
    assert state["cells_v"] == blocks["b"][-1].cells_v[-1].tolist()
    assert (state["weakest_cell"], state["weakest_cell_soc"]) == (WEAK + 1, cells.deviations.soc[WEAK])
    published = [number for number, result in enumerate(results, 1) if result.cells]
    assert published == [1, 61]  # the first block of each hour
    _, cells = replayed(blocks["b"][:61])
    report = json.loads(results[60].cells)
    assert [cell["soc"] for cell in report["cells"]] == cells.deviations.soc.tolist()


def test_state_agrees_in_every_field_with_that_of_a_replay(blocks):
    _, results = run(Partition(0, table, wall=lambda: 0.0), {"b": blocks["b"]})
    pack = assemble(
        make_estimator(SETTINGS, MODEL), SETTINGS, lambda estimator, _: SlowFit(estimator, interval_s=math.inf)
    )
    meter, window = ChargeEnergyMeter(ChargeEnergy(), float(pack.estimator.settings["gap_s"][0])), Window()
    for block in (decode(encode(block)) for block in blocks["b"]):
        trace = pack.run(block.samples, block.cells_v).trace
        meter.add(trace)
        totals = meter.update_totals()
        window.add(trace, block.arrival_s, block.cells_v)
        summary = window.take()
    replayed = make_state_payload(
        summary,
        remaining_capacity_ah(pack.estimator),
        pack.forecaster.forecast(),
        {"frames_received": MINUTES},
        0.0,
        totals,
        CAPACITY_AH,
        single_cell_fields(pack),
    )
    state, expected = json.loads(results[-1].state), json.loads(replayed.model_dump_json())
    assert state.keys() == expected.keys()
    peaks = "usable_capacity_ah", "remaining_energy_wh"  # a worker does not know the peaks of the load
    assert [state[name] for name in peaks] == pytest.approx([expected[name] for name in peaks], rel=0.02)
    forecast_only = {*FORECAST_FIELDS, "forecast_reason"}
    assert {name for name in state if state[name] != expected[name]} <= forecast_only
    assert state["usable_capacity_ah"] < 0.9 * state["soc"] * CAPACITY_AH  # the weak cell is empty first


def test_state_has_the_last_known_cell_voltages_of_a_block():
    (block,) = minutes(1, 1)
    block.cells_v[-1] = math.nan
    result = Partition(0, table).process("a", encode(block), 1)
    assert json.loads(result.state)["cells_v"] == block.cells_v[-2].tolist()


def test_hourly_row_has_the_estimates_of_the_weakest_and_of_the_leaking_cell(blocks):
    _, results = run(Partition(0, table), {"b": blocks["b"]})
    ((_, data),) = [hour for result in results for hour in result.hours]
    row = Hour.model_validate_json(data)
    _, cells = replayed(blocks["b"][: row.samples // 60])
    assert row.weakest_cell == WEAK + 1
    assert row.weakest_cell_soc_deviation == cells.deviations.soc_deviation[WEAK]
    assert row.weakest_cell_resistance_ratio == cells.deviations.resistance_ratio[WEAK]
    assert row.cell_soc_spread == np.ptp(cells.deviations.soc_deviation)
    leaking = row.self_discharge_cell - 1
    assert row.self_discharge_a == cells.deviations.self_discharge_a[leaking]
    assert row.self_discharge_std_a == cells.deviations.self_discharge_std_a[leaking]


def test_blocks_with_more_cells_than_the_pack_has_do_not_stop_it(blocks):
    first, *others = blocks["b"]
    surplus = np.full((60, 1), 3.0)
    others = [replace(block, cells_v=np.hstack([block.cells_v, surplus])) for block in others]
    partition, results = run(Partition(0, table), {"b": [first, *others]})
    assert not any(result.failed for result in results)
    ((_, data),) = [hour for result in results for hour in result.hours]
    row = Hour.model_validate_json(data)
    assert row.weakest_cell == WEAK + 1
    assert partition.cells("b").size == CELLS


def test_pack_without_cell_voltages_stores_and_publishes_nothing_of_cells(blocks):
    without = [replace(block, cells_v=NO_CELLS) for block in blocks["b"]]
    partition, results = run(Partition(0, table), {"a": without, "b": blocks["b"]})
    assert partition.cells("a").size == 0
    snapshot = partition.snapshot()
    assert (set(snapshot.packs), set(snapshot.other_layouts)) == ({"a"}, {"b"})
    assert not any(result.cells for result in results if result.pack == "a")
    ((_, data),) = [hour for result in results if result.pack == "a" for hour in result.hours]
    assert b"cell_soc_spread" not in data
    assert b"self_discharge" not in data


def test_earlier_version_drops_the_cells_and_keeps_the_estimator(blocks, monkeypatch):
    first, last = ({pack: of_pack[part] for pack, of_pack in blocks.items()} for part in (slice(60), slice(60, None)))
    partition, _ = run(Partition(0, table), first)
    # an earlier version reads the record with cells by the names of its fields
    with monkeypatch.context() as earlier:
        earlier.setattr(pack_records, "cell_count", lambda _: 0)
        earlier.setattr("bms_estimator.fleet.worker.pack_state.UnpackedRecord._copy_cells", lambda *_: None)
        earlier.setattr(CellEstimator, "estimated_cells", 0)
        older = restored(partition)
        for number, pack in enumerate(PACKS, 1 + partition.sequence):
            older.process(pack, encode(last[pack][0]), number)
        data = b"".join(older.snapshot().chunks())
    assert older.snapshot().other_layouts == {}
    partition = Partition.restore(0, table, data)
    for offset in range(1, 10):
        for pack in PACKS:
            partition.process(pack, encode(last[pack][offset]), partition.sequence + 1)
    for pack in PACKS:
        estimator, _ = replayed(blocks[pack])
        assert estimates_of(partition.state(pack)["estimator"]) == estimates_of(estimator.record)
        assert partition.cells(pack)["samples"].size == CELLS  # the estimators of the cells were reset


def test_later_version_with_other_fields_keeps_the_cells(blocks, monkeypatch):
    partition, _ = run(Partition(0, table), blocks)
    monkeypatch.setattr(pack_records, "cell_count", lambda _: 0)  # the later version has another layout
    later = restored(partition)
    assert set(later.snapshot().other_layouts) == set(PACKS)
    before = {pack: partition.cells(pack).tobytes() for pack in PACKS}
    for pack in PACKS:  # a repeated block migrates the record
        later.process(pack, encode(blocks[pack][-1]), later.sequence + 1)
        assert later.cells(pack).tobytes() == before[pack]


def test_cells_are_kept_with_another_tuning_and_begin_anew_with_another_capacity(blocks):
    packs = {"b": blocks["b"][:20]}
    partition, _ = run(Partition(0, table), packs)
    windows_before = partition.cells("b")["covariance"].copy()
    data, block = b"".join(partition.snapshot().chunks()), blocks["b"][20]
    tuned = SETTINGS.model_copy(update={"identifier": SETTINGS.identifier.model_copy(update={"soc_std": 0.2})})
    larger = load_cell("nmc", 2 * CAPACITY_AH).pack(CELLS, 1)
    stds = []
    for entry in ((tuned, MODEL), (SETTINGS, larger)):
        partition = Partition.restore(0, lambda _, entry=entry: entry, data)
        partition.process("b", encode(block), partition.sequence + 1)
        stds.append(partition.cells("b")["covariance"][0, 0, 0])
    assert stds[0] < 1.5 * windows_before[0, 0, 0] < stds[1]


def test_gap_at_a_new_store_counts_as_a_gap_of_the_cells(blocks):
    gap_s = 7200.0
    partition, _ = run(Partition(0, table), {"b": blocks["b"][:20]})
    last_s = float(blocks["b"][19].samples["time_s"][-1])
    new_store = STORE_ID_NS + round((last_s + gap_s) * 1e9)
    block = replace(blocks["b"][0], store_created_ns=new_store, arrival_s=new_store / 1e9 + 60.0)
    block = replace(block, samples=block.samples.copy())
    block.samples["time_s"] -= block.samples["time_s"][0]
    partition.process("b", encode(block), partition.sequence + 1)
    estimator, cells = replayed(blocks["b"][:20])
    estimator.resume(gap_s)
    cells.resume(gap_s)
    cells.run(block.samples, block.cells_v, estimator.run(block.samples))
    assert partition.cells("b").tobytes() == cells.cells.tobytes()


def test_layouts_of_other_records_are_not_taken_for_those_of_cells():
    assert [cell_count(layout) for layout in (CURRENT_LAYOUT, cell_layout(3), cell_layout(128))] == [0, 3, 128]
    assert cell_count(cell_layout(3).replace("sum_v", "sum_x")) == 0
