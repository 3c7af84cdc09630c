"""Simulation of the whole service: short worlds, reproducibility, and mutants that must be found."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from tests.world.faults import Fault
from tests.world.mutants import board_clock_believed, no_fsync, no_rewind, no_second_try, no_sensor_availability
from tests.world.world import World

SEEDS = [0, 1, pytest.param(2, marks=pytest.mark.thorough)]
WORLD_S = 1000.0
"""Duration of a world [s]; the last seven minutes are without faults."""
SILENCE_S = 21.0
"""Maximum time until a silent connection is closed [s] (docs/reference/mqtt.md)."""


@pytest.mark.parametrize("seed", SEEDS)
def test_all_invariants_hold(seed: int) -> None:
    result = World(seed, WORLD_S).run()
    assert not result.wrong, "\n".join([*result.log, f"make simulate SEED={seed}: {result.wrong}"])


def test_seed_is_reproducible() -> None:
    first, second = World(7, 600.0).run(), World(7, 600.0).run()
    assert first.digest == second.digest
    assert first.figures == second.figures


@pytest.mark.parametrize(
    ("mutant", "faults", "found"),
    [
        (no_rewind, [Fault(60.0, "connections half open", 60.0, 0.5)], "the broker never got"),
        (no_fsync, [Fault(60.0 + 7.0 * n, "power cut", 2.0, 0.5) for n in range(1, 40)], "the checkpoint is refused"),
        (no_sensor_availability, [Fault(60.0, "port gone", 120.0, 0.5)], "sensor availability"),
        (no_second_try, [Fault(0.05, "disk full", 60.0, 0.5)], "is not remembered"),
        (board_clock_believed, [Fault(60.0, "board's clock stepped", 0.0, 0.9)], "s too much are counted"),
    ],
)
def test_mutant_is_found(mutant: Callable[[], AbstractContextManager[None]], faults: list[Fault], found: str) -> None:
    with mutant():
        result = World(2, 600.0, faults).run()
    assert found in result.wrong


def test_late_broker_causes_no_uncaught_exception() -> None:
    result = World(1, 600.0, [Fault(60.0, "broker frozen", 60.0, 0.5)]).run()
    assert not result.wrong
    assert any("no answer within" in line for line in result.log)


@pytest.mark.parametrize("kind", ["connections half open", "broker frozen"])
def test_silent_connection_is_closed_in_time(kind: str) -> None:
    begin_s = 60.0
    result = World(1, 600.0, [Fault(begin_s, kind, 100.0, 0.5)]).run()
    lost_s = next(float(line.split()[0]) for line in result.log if "broker lost" in line)
    assert lost_s - begin_s <= SILENCE_S
    assert not result.wrong
