"""The true SOC that the demo shows belongs to the same sample as the shown estimate."""

import math

import pytest

from bms_estimator.demo.true_soc import PackWithSocHistory
from bms_estimator.model.cell import load_cell
from bms_estimator.protocols.firmware.messages import MODULUS, SampleMessage
from bms_estimator.simulation.simulated_pack import SimulatedPack, constant

LOAD_A, START_SOC, STEP_S = 0.275, 0.9, 0.02
FALL_PER_S = 1.0 / 3600.0
"""Decrease of the SOC under ``LOAD_A``, which is the 1C current [1/s]."""
STEP_TOLERANCE = FALL_PER_S * STEP_S
"""Change of the SOC in one step of the simulation."""


def frame(at_s: float) -> bytes:
    """Return the frame of a sample whose board time is ``at_s``."""
    board_us = round(at_s * 1e6) % MODULUS
    return SampleMessage(
        sequence=0, board_us=board_us, voltage_sum=1, current_sum=1, count=1, aux_sum=0, aux_count=0, status=0
    ).encode()


@pytest.fixture
def truth() -> PackWithSocHistory:
    """Return the recorder of the true SOC of a pack that is simulated for five minutes, before any frame is received."""
    truth = PackWithSocHistory(SimulatedPack(load_cell("chen_mora"), constant(LOAD_A), soc=START_SOC))
    for step in range(1, round(300.0 / STEP_S)):
        truth(step * STEP_S)
    return truth


def soc_at(at_s: float) -> float:
    return START_SOC - FALL_PER_S * at_s


def test_true_soc_is_that_of_the_last_complete_sample_although_the_simulation_is_ahead(
    truth: PackWithSocHistory,
) -> None:
    assert truth.soc() == START_SOC
    truth.write(0.0, frame(10.0) + frame(60.0))
    assert truth.soc() == pytest.approx(soc_at(60.0), abs=STEP_TOLERANCE)
    later = frame(90.0)
    truth.write(0.0, later[:7])  # an incomplete frame
    assert truth.soc() == pytest.approx(soc_at(60.0), abs=STEP_TOLERANCE)
    truth.write(0.0, later[7:])
    assert truth.soc() == pytest.approx(soc_at(90.0), abs=STEP_TOLERANCE)


def test_noise_on_the_line_does_not_change_the_true_soc(truth: PackWithSocHistory) -> None:
    truth.write(0.0, frame(30.0))
    truth.write(0.0, b"\x05noise\0\0\xff" * 9)
    assert truth.soc() == pytest.approx(soc_at(30.0), abs=STEP_TOLERANCE)


def test_true_soc_continues_after_a_wrap_of_the_board_clock() -> None:
    wrap_s = MODULUS * 1e-6
    pack = SimulatedPack(load_cell("chen_mora"), constant(0.01), soc=START_SOC)
    truth = PackWithSocHistory(pack)
    for minute in range(1, math.ceil(wrap_s / 60.0) + 20):
        truth(60.0 * minute)
        truth.write(0.0, frame(60.0 * minute))
        assert truth.soc() == pack.soc
