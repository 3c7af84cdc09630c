"""Simulated packs: their blocks, their true SOC, and the block order of their edges."""

import numpy as np
import pytest

from bms_estimator.edge.block import decode
from bms_estimator.edge.subjects import BlockRequest
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.fleet.simulation.simulated_edges import RESEND_S, SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import BLOCK_S, KINDS, SimulatedFleet
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import Sampling

BEGIN_NS = 1_800_000_000 * 10**9
HOURS = 4


def fleet(packs: int, seed: int = 1) -> SimulatedFleet:
    return SimulatedFleet(packs, seed=seed, begin_ns=BEGIN_NS)


def test_block_depends_only_on_seed_pack_and_number() -> None:
    four_packs, pack_6 = np.array([0, 5, 6, 7]), np.array([6])
    arrival_s = np.full(4, 1.8e9)
    with_others = list(fleet(8).blocks(four_packs, np.array([3, 1, 900, 2]), arrival_s))
    alone = next(fleet(1000).blocks(pack_6, np.array([900]), arrival_s[:1]))
    assert with_others[2] == alone
    block = decode(alone)
    assert (block.number, block.oldest, block.samples.size, block.store_created_ns) == (
        900,
        1,
        BLOCK_S,
        fleet(8).store_created_ns[6],
    )
    assert next(fleet(8, seed=2).blocks(pack_6, np.array([900]), arrival_s[:1])) != alone


def test_time_and_true_soc_are_continuous_between_successive_blocks() -> None:
    packs = np.arange(8)
    first, second = (fleet(8).samples(packs, np.full(8, number)) for number in (41, 42))
    time_s = np.concatenate((first["time_s"], second["time_s"]), axis=1)
    assert (np.diff(time_s, axis=1) > 0.9).all()
    assert np.abs(time_s[:, 0] - 40 * BLOCK_S).max() < 1.0
    boundary_s = 41.0 * BLOCK_S
    before, after = (fleet(8).soc(packs, np.full(8, boundary_s + offset_s)) for offset_s in (-1e-6, 1e-6))
    assert before == pytest.approx(after, abs=1e-8)


def test_charge_of_the_samples_agrees_with_the_change_of_the_true_soc() -> None:
    simulated = fleet(len(KINDS))
    packs, begin, end = np.arange(len(KINDS)), 7, 127  # numbers of blocks
    charge_as = sum(
        simulated.samples(packs, np.full(packs.size, n))["current_a"].sum(axis=1) for n in range(begin, end)
    )
    socs = [simulated.soc(packs, np.full(packs.size, (n - 1.0) * BLOCK_S)) for n in (begin, end)]
    assert charge_as / simulated.true_capacity_as == pytest.approx(socs[0] - socs[1], abs=2e-4)


def test_estimator_with_the_settings_of_each_kind_of_pack_converges_to_the_true_soc() -> None:
    simulated = fleet(len(KINDS))
    is_inside_band = []
    for pack, kind in enumerate(KINDS):
        cell = load_cell(kind.cell, kind.capacity_ah).pack(kind.series, kind.parallel)
        sampling = Sampling(kind.current_resolution_a, 0.0, 1.0)  # without a dead band, at 1 Hz
        estimator = Estimator(cell, voltage_resolution_v=kind.voltage_resolution_v, sampling=sampling)
        for number in range(1, HOURS * 60 + 1):
            samples = simulated.samples(np.array([pack]), np.array([number]))[0]
            row = estimator.run(samples)[-1]
            truth = simulated.soc(np.array([pack]), samples["time_s"][-1:])[0]
            is_inside_band.append(abs(row["soc"] - truth) < 3.0 * row["soc_std"])
        assert row["soc"] == pytest.approx(truth, abs=0.1)
    assert np.mean(is_inside_band) > 0.9


def test_edges_send_each_complete_block_once_and_the_oldest_first() -> None:
    simulated = fleet(50)
    edges = SimulatedEdges(simulated, start_s=1000.0, speed=60.0)  # a block of a minute takes one second
    assert edges.due(1000.9, 100).packs.size == 0
    first_due = edges.due(1003.0, 7)
    assert first_due.packs.size == 7
    # the oldest unsent block was completed after those that were sent
    assert edges.lag_s(1003.0) <= 1003.0 - first_due.arrival_s.max()
    remaining = edges.due(1003.0, 100)
    assert set(remaining.packs[remaining.numbers == 1]) | set(first_due.packs) == set(range(50))
    assert (remaining.arrival_s <= 1003.0).all()
    assert edges.repeated == 0


def test_edges_resend_from_the_requested_block() -> None:
    simulated = fleet(2)
    edges = SimulatedEdges(simulated, start_s=0.0, speed=60.0, last=4)
    while edges.due(100.0, 10).packs.size:  # send all blocks
        pass
    assert edges.done
    assert edges.sent == 8
    store = int(simulated.store_created_ns[1])
    assert not edges.receive_reply("someone-else", BlockRequest(store=store, number=2, resend=True), 0.0)
    assert not edges.receive_reply(simulated.names[1], BlockRequest(store=store + 1, number=2, resend=True), 0.0)
    assert edges.receive_reply(simulated.names[1], BlockRequest(store=store, number=3, resend=True), 0.0)
    assert not edges.done
    resent = [edges.due(100.0, 10) for _ in range(3)]
    assert [list(zip(due.packs, due.numbers, strict=True)) for due in resent] == [[(1, 3)], [(1, 4)], []]
    assert (edges.repeated, edges.resends, edges.confirmed_below[1]) == (2, 1, 3)
    # A request is ignored if its block was resent recently. Confirmed blocks are not resent.
    edges.receive_reply(simulated.names[1], BlockRequest(store=store, number=3, resend=True), RESEND_S / 2.0)
    assert edges.done
    edges.receive_reply(simulated.names[1], BlockRequest(store=store, number=2, resend=True), RESEND_S)
    assert edges.next_number.tolist() == [5, 3]


def test_edge_does_not_send_confirmed_blocks() -> None:
    simulated = fleet(1)
    edges = SimulatedEdges(simulated, start_s=0.0, speed=60.0)
    edges.receive_reply(
        simulated.names[0], BlockRequest(store=int(simulated.store_created_ns[0]), number=40, resend=False), 0.0
    )
    assert edges.due(30.0, 10).packs.size == 0
    assert edges.due(41.0, 10).numbers.tolist() == [40]
