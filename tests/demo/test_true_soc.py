"""The truth that the demo shows belongs to the very sample that the estimate is of."""

import math

import pytest

from bms_estimator.demo.true_soc import TrueSoc
from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.firmware.messages import MODULUS, SampleMessage
from bms_estimator.simulation.simulated_pack import SimulatedPack, constant

LOAD_A, START_SOC, STEP_S = 0.275, 0.9, 0.02
FALL_PER_S = 1.0 / 3600.0
"""At 1C."""


def frame(at_s: float) -> bytes:
    board_us = round(at_s * 1e6) % MODULUS
    return SampleMessage(0, board_us, 1, 1, 1, 0, 0, 0).encode()


@pytest.fixture
def truth() -> TrueSoc:
    """True SOC of a pack that a simulator has read five minutes ahead."""
    truth = TrueSoc(SimulatedPack(load_cell("chen_mora"), constant(LOAD_A), soc=START_SOC))
    for step in range(1, round(300.0 / STEP_S)):
        truth(step * STEP_S)
    return truth


def soc_at(at_s: float) -> float:
    return START_SOC - FALL_PER_S * at_s


def test_the_truth_is_of_the_last_whole_sample_that_came_though_the_pack_has_run_ahead(truth: TrueSoc) -> None:
    assert truth.soc() == START_SOC
    truth.write(0.0, frame(10.0) + frame(60.0))
    assert truth.soc() == pytest.approx(soc_at(60.0), abs=FALL_PER_S * STEP_S)
    later = frame(90.0)
    truth.write(0.0, later[:7])
    assert truth.soc() == pytest.approx(soc_at(60.0), abs=FALL_PER_S * STEP_S)
    truth.write(0.0, later[7:])
    assert truth.soc() == pytest.approx(soc_at(90.0), abs=FALL_PER_S * STEP_S)


def test_bytes_that_are_no_sample_do_not_move_the_truth(truth: TrueSoc) -> None:
    truth.write(0.0, frame(30.0))
    truth.write(0.0, b"\x05noise\0\0\xff" * 9)
    assert truth.soc() == pytest.approx(soc_at(30.0), abs=FALL_PER_S * STEP_S)


def test_the_truth_goes_on_when_the_board_s_clock_has_turned_over(truth: TrueSoc) -> None:
    turn_s = MODULUS * 1e-6
    pack = SimulatedPack(load_cell("chen_mora"), constant(0.01), soc=START_SOC)
    slow = TrueSoc(pack)
    for minute in range(1, math.ceil(turn_s / 60.0) + 20):
        slow(60.0 * minute)
        slow.write(0.0, frame(60.0 * minute))
        assert slow.soc() == pack.soc
