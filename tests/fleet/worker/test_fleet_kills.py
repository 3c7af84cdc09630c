"""Worker and server killed while edges send: no sample is lost or counted twice. ``make fleet-kills`` runs longer."""

import pytest

from tests.benchmarks.fleet_kills import Plan, run

pytestmark = pytest.mark.thorough


def test_kills_do_not_change_the_final_states() -> None:
    plan = Plan(nodes=1, kills=2, packs=8, seed=3, mean_s=0.2, partitions=4)
    outcome = run(plan)
    assert outcome.wrong == []
    assert set(outcome.killed) == {"node", "worker"}
    assert outcome.blocks == outcome.counters["blocks"] > plan.packs
    assert outcome.counters["lost_blocks"] == 0
