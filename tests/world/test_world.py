"""Simulation of the whole service: short worlds, reproducibility, and mutants that must be violation."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from tests.world.faults import Fault
from tests.world.mutants import (
    no_check_of_board_clock,
    no_fsync,
    no_retry_after_disk_full,
    no_rewind,
    no_sensor_availability,
)
from tests.world.world import World

SEEDS = [0, 1, pytest.param(2, marks=pytest.mark.thorough)]
WORLD_S = 1000.0
"""Duration of a world [s]. No fault is drawn in its last ``FAULT_FREE_S``, so that the service can recover."""
SILENCE_S = 21.0
"""Maximum time until a silent connection is closed [s] (docs/reference/mqtt.md)."""


def fault(kind: str, begin_s: float = 60.0, duration_s: float = 60.0, severity: float = 0.5) -> Fault:
    return Fault(begin_s, kind, duration_s, severity)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_invariants_hold(seed: int) -> None:
    result = World(seed, WORLD_S).run()
    assert not result.violation, "\n".join([*result.log, f"make simulate SEED={seed}: {result.violation}"])


def test_seed_is_reproducible() -> None:
    first, second = World(7, 600.0).run(), World(7, 600.0).run()
    assert first.digest == second.digest
    assert first.figures == second.figures


@pytest.mark.parametrize(
    ("mutant", "faults", "violation"),
    [
        (no_rewind, [fault("connections half open")], "the broker never got"),
        (
            no_fsync,
            [fault("power cut", begin_s=60.0 + 7.0 * n, duration_s=2.0) for n in range(1, 40)],
            "the checkpoint is refused",
        ),
        (no_sensor_availability, [fault("port gone", duration_s=120.0)], "sensor availability"),
        # begins before the board is identified, so that its serial number cannot be saved
        (no_retry_after_disk_full, [fault("disk full", begin_s=0.05)], "is not remembered"),
        # a severity above 0.5 steps the clock ahead
        (no_check_of_board_clock, [fault("board's clock stepped", severity=0.9)], "s too much are counted"),
    ],
)
def test_mutant_is_found(
    mutant: Callable[[], AbstractContextManager[None]], faults: list[Fault], violation: str
) -> None:
    with mutant():
        result = World(2, 600.0, faults).run()
    assert violation in result.violation


def test_late_broker_causes_no_uncaught_exception() -> None:
    result = World(1, 600.0, [fault("broker frozen")]).run()
    assert not result.violation
    assert any("no answer within" in line for line in result.log)


@pytest.mark.parametrize("kind", ["connections half open", "broker frozen"])
def test_silent_connection_is_closed_in_time(kind: str) -> None:
    begin_s = 60.0
    result = World(1, 600.0, [fault(kind, begin_s=begin_s, duration_s=100.0)]).run()
    lost_s = next(float(line.split()[0]) for line in result.log if "broker lost" in line)
    assert lost_s - begin_s <= SILENCE_S
    assert not result.violation
