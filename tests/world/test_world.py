"""Simulation of the whole service: short worlds, reproducibility, and mutants that the simulation must find."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from tests.world.faults import Fault
from tests.world.mutants import (
    no_check_of_board_clock,
    no_fsync,
    no_resend_after_reconnect,
    no_retry_after_disk_full,
    no_sensor_availability,
)
from tests.world.world import World

SEEDS = [0, 1, pytest.param(2, marks=pytest.mark.thorough)]
WORLD_S = 1000.0
"""Duration of a world [s]. No fault is drawn in its last ``FAULT_FREE_S``, so that the service can recover."""
SILENCE_S = 21.0
"""Maximum time until a silent connection is closed [s] (docs/reference/mqtt.md)."""


def make_fault(kind: str, *, begin_s: float = 60.0, duration_s: float = 60.0, severity: float = 0.5) -> Fault:
    return Fault(begin_s, kind, duration_s, severity)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_service_keeps_all_invariants_under_random_faults(seed: int) -> None:
    result = World(seed, seconds=WORLD_S).run()
    assert not result.violation, "\n".join([*result.log, f"make simulate SEED={seed}: {result.violation}"])


def test_a_seed_always_gives_the_same_world() -> None:
    first, second = World(seed=7, seconds=600.0).run(), World(seed=7, seconds=600.0).run()
    assert first.digest == second.digest
    assert first.figures == second.figures


@pytest.mark.parametrize(
    ("mutant", "faults", "violation"),
    [
        (no_resend_after_reconnect, [make_fault("connections half open")], "the broker never got"),
        (
            no_fsync,
            # A cut damages an unsynced checkpoint only by chance, so there are 39 cuts.
            [make_fault("power cut", begin_s=60.0 + 7.0 * n, duration_s=2.0) for n in range(1, 40)],
            "the checkpoint is refused",
        ),
        (no_sensor_availability, [make_fault("port gone", duration_s=120.0)], "sensor availability"),
        # The disk is full before the board is identified, so that its serial number cannot be saved.
        (no_retry_after_disk_full, [make_fault("disk full", begin_s=0.05)], "is not remembered"),
        # A severity above 0.5 steps the clock ahead.
        (no_check_of_board_clock, [make_fault("board's clock stepped", severity=0.9)], "s too much are counted"),
    ],
)
def test_the_simulation_finds_the_bug_of_a_mutant(
    mutant: Callable[[], AbstractContextManager[None]], faults: list[Fault], violation: str
) -> None:
    with mutant():
        result = World(seed=2, seconds=600.0, faults=faults).run()
    assert violation in result.violation


def test_a_broker_that_is_frozen_for_a_minute_causes_no_uncaught_exception() -> None:
    result = World(seed=1, seconds=600.0, faults=[make_fault("broker frozen")]).run()
    assert not result.violation
    assert any("no answer within" in line for line in result.log)


@pytest.mark.parametrize("kind", ["connections half open", "broker frozen"])
def test_the_service_closes_a_connection_on_which_the_broker_is_silent(kind: str) -> None:
    begin_s = 60.0
    result = World(seed=1, seconds=600.0, faults=[make_fault(kind, begin_s=begin_s, duration_s=100.0)]).run()
    closed_s = next(float(line.split()[0]) for line in result.log if "broker lost" in line)
    assert closed_s - begin_s <= SILENCE_S
    assert not result.violation
