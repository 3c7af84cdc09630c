"""Rate error of the board's clock from the arrival times of its samples."""

import dataclasses
import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import Hello, SampleMessage, unseal
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from bms_estimator.sources.captures.replay import RawCapture, Replay
from tests.protocols.firmware.test_decoder_fuzz import HELLO

START_S = 1_700_000_000.0
FAST = 1.003
"""Seconds of the board's clock in one second of the host's."""
TOLERANCE_PPM = 100.0
BATCH_S = 0.016
"""Interval at which an FTDI bridge delivers received bytes [s]."""

Read = tuple[float, bytes]


def reads(seconds: float, *, boot_id: int = 1, start_s: float = START_S, seed: int = 1) -> Iterator[Read]:
    """What a host reads of a board that runs fast, at 10 Hz: late by an exponential 3 ms, in batches, held up for 4 s in 20."""
    random = np.random.default_rng(seed)
    hello = dataclasses.replace(Hello.decode(unseal(HELLO)), boot_id=boot_id)
    yield start_s, hello.encode()
    last_s = start_s
    for i in range(int(10 * seconds)):
        board_us = 100_000 * (i + 1)
        at_s = start_s + board_us * 1e-6 / FAST
        come_s = at_s + 0.001 + random.exponential(0.003)
        if (at_s - start_s) % 20.0 > 16.0:
            come_s = start_s + 20.0 * np.ceil((at_s - start_s) / 20.0)
        last_s = max(last_s, BATCH_S * np.ceil(come_s / BATCH_S))
        yield last_s, SampleMessage(i, board_us, 34_571, 21_405, 38, 225, 1, 16).encode()


def fed(*parts: Iterator[Read]) -> FrameDecoder:
    decoder = FrameDecoder()
    for arrival_s, data in itertools.chain(*parts):
        decoder.feed(arrival_s, data)
    return decoder


def ppm(decoder: FrameDecoder | Replay) -> float:
    assert decoder.clock_ppm is not None
    return decoder.clock_ppm


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("seconds", [90.0, 600.0, 1500.0])
def test_fast_clock_is_measured_despite_delays(seconds: float, seed: int) -> None:
    assert ppm(fed(reads(seconds, seed=seed))) == pytest.approx(3000.0, abs=TOLERANCE_PPM)


def test_rate_is_unknown_in_the_first_minute() -> None:
    assert fed(reads(55.0)).clock_ppm is None
    assert FrameDecoder().clock_ppm is None


def test_rate_is_unknown_if_all_samples_arrive_together() -> None:
    decoder = FrameDecoder()
    decoder.feed(START_S, b"".join(data for _, data in reads(90.0)))
    assert decoder.clock_ppm is None


def test_implausible_rate_is_none() -> None:
    slept = ((START_S + 0.9 * (at_s - START_S), data) for at_s, data in reads(120.0))
    assert fed(slept).clock_ppm is None


def test_measurement_restarts_after_a_board_reset() -> None:
    before, later_s = reads(120.0), START_S + 300.0
    assert fed(before, reads(50.0, boot_id=2, start_s=later_s)).clock_ppm is None
    assert ppm(fed(reads(120.0), reads(120.0, boot_id=2, start_s=later_s))) == pytest.approx(3000.0, abs=TOLERANCE_PPM)


def test_outage_does_not_change_the_rate() -> None:
    heard = (read for read in reads(300.0) if not 60.0 < read[0] - START_S < 200.0)
    assert ppm(fed(heard)) == pytest.approx(3000.0, abs=TOLERANCE_PPM)


def stamped(board_us: Callable[[int, int], int], seconds: int = 60) -> FrameDecoder:
    """After samples at 10 Hz that came in time, with stamps changed by ``board_us`` of number and true stamp."""
    decoder = FrameDecoder()
    decoder.feed(START_S, HELLO)
    for i in range(10 * seconds):
        true_us = 100_000 * (i + 1)
        message = SampleMessage(i, board_us(i, true_us) % 2**32, 34_571, 21_405, 38, 225, 1, 16)
        decoder.feed(START_S + true_us * 1e-6, message.encode())
    return decoder


@pytest.mark.parametrize(
    ("board_us", "least", "most"),
    [
        (lambda i, us: us + (3_000_000_000 if i == 300 else 0), 2, 2),
        (lambda i, us: us + (3_000_000_000 if i >= 300 else 0), 1, 1),
        (lambda i, us: us - (20_000_000 if i >= 300 else 0), 1, 1),
        (lambda i, us: us if not 300 <= i < 330 else 2_654_435_761 * (i + 1), 3, 40),
    ],
    ids=["one ahead", "ahead from now on", "back", "at random for 3 s"],
)
def test_jump_of_the_clock_is_rejected(board_us: Callable[[int, int], int], least: int, most: int) -> None:
    """Time goes on by arrival: no charge is counted for time that was none."""
    decoder = stamped(board_us)
    last = decoder.feed(
        START_S + 60.1, SampleMessage(600, board_us(600, 60_100_000) % 2**32, 34_571, 21_405, 38, 225, 1, 16).encode()
    )
    assert last["time_s"][0] == pytest.approx(60.0, abs=1e-3)
    assert least <= decoder.counters.clock_jumps <= most


def test_clock_jitter_below_the_limit_does_not_accumulate() -> None:
    """Each step ahead is believed, each back is not: what was believed is taken back."""
    decoder = stamped(lambda i, us: us + (400_000 * (i * 7919 % 5) if 100 <= i < 500 else 0))
    last = decoder.feed(START_S + 60.1, SampleMessage(600, 60_100_000, 34_571, 21_405, 38, 225, 1, 16).encode())
    assert decoder.counters.clock_jumps > 50
    assert last["time_s"][0] == pytest.approx(60.0, abs=2.0)


def test_wrong_clock_after_a_reset_is_rejected() -> None:
    decoder = stamped(lambda _, us: us)
    decoder.feed(START_S + 70.0, dataclasses.replace(Hello.decode(unseal(HELLO)), boot_id=99).encode())
    ((time_s, *_),) = decoder.feed(
        START_S + 70.0, SampleMessage(0, 2_400_000_000, 34_571, 21_405, 38, 225, 1, 16).encode()
    )
    assert time_s == pytest.approx(69.9)
    assert decoder.counters.clock_jumps == 1


def test_clock_set_back_during_an_outage_is_rejected() -> None:
    """For 100 s nothing came, and so many samples are lost, though the board says 20 s; no hello tells whose they are."""
    decoder = FrameDecoder()
    decoder.feed(START_S, dataclasses.replace(Hello.decode(unseal(HELLO)), period_ns=100_000_000).encode())
    times_s: list[float] = []
    for i in (*range(300), *range(1300, 1400)):
        board_us = 100_000 * (i + 1) - (80_000_000 if i >= 1300 else 0)
        message = SampleMessage(i, board_us, 34_571, 21_405, 38, 225, 1, 16)
        times_s.extend(decoder.feed(START_S + 0.1 * (i + 1), message.encode())["time_s"])
    assert times_s[-1] == pytest.approx(139.9)  # the first sample came at 0.1 s
    assert decoder.counters.clock_jumps == 1


def test_board_clock_is_used_after_a_host_stall() -> None:
    """What waited in the buffer comes at once, then what the buffer had no room for is missing."""
    decoder = FrameDecoder()
    decoder.feed(START_S, dataclasses.replace(Hello.decode(unseal(HELLO)), period_ns=100_000_000).encode())
    frames = {i: SampleMessage(i, 100_000 * (i + 1), 34_571, 21_405, 38, 225, 1, 16).encode() for i in range(1200)}
    for i in range(300):
        decoder.feed(START_S + 0.1 * (i + 1), frames[i])
    decoder.feed(START_S + 90.0, b"".join(frames[i] for i in range(300, 450)))
    last = decoder.feed(START_S + 90.1, frames[900])
    assert decoder.counters.clock_jumps == 0
    assert last["time_s"][0] == pytest.approx(90.0)


def test_sample_times_are_those_of_the_board() -> None:
    decoder = FrameDecoder()
    time_s = np.concatenate([decoder.feed(*read)["time_s"] for read in reads(90.0)])
    assert np.array_equal(time_s, 1e-6 * (100_000 * np.arange(900)))


async def test_replay_gives_the_same_rate_bit_for_bit(tmp_path: Path) -> None:
    recorded = list(reads(90.0))
    with CaptureWriter(tmp_path / "line.bms", CaptureHeader()) as writer:
        for read in recorded:
            writer.write(*read)
    replay = Replay(RawCapture(tmp_path / "line.bms"))
    async for _ in replay:
        pass
    assert ppm(replay) == ppm(fed(iter(recorded)))


def test_clock_kernels_are_compiled_before_samples_arrive() -> None:
    program = (
        "from bms_estimator.protocols.firmware.clock_drift import clock_ppm; from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder; "
        "FrameDecoder(); assert clock_ppm.signatures"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
