"""Board's clock, compared with the arrival times of the samples: its rate error is measured, its jumps are rejected."""

import itertools
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.framing import MAX_LEAD_S
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from bms_estimator.sources.captures.replay import RawCapture, Replay
from tests.protocols.firmware.board_messages import HELLO, encode_hello, encode_sample

START_S = 1_700_000_000.0
PERIOD_S = 0.1
PERIOD_US = 100_000
CLOCK_RATIO = 1.003
"""Seconds of the board's clock in one second of the host's."""
CLOCK_PPM = 3000.0
"""Rate error of the board's clock in units of 1e-6, from ``CLOCK_RATIO``."""
TOLERANCE_PPM = 100.0
BATCH_S = 0.016
"""Interval at which an FTDI bridge delivers received bytes [s]."""
STALL_INTERVAL_S = 20.0
"""Interval of the stalls of the host [s]."""
STALL_BEGIN_S = 16.0
"""Begin of a stall in each interval [s]. The stall lasts to the end of the interval."""

Read = tuple[float, bytes]
"""Arrival time [s] and bytes."""


def generate_reads(seconds: float, *, boot_id: int = 1, start_s: float = START_S, seed: int = 1) -> Iterator[Read]:
    """Yield the reads of a host from a 10 Hz board with a fast clock.

    Reads are delayed by 1 ms and an exponential 3 ms, come in batches, and stall for 4 s of every 20 s.
    """
    random = np.random.default_rng(seed)
    yield start_s, encode_hello(boot_id=boot_id)
    last_read_s = start_s
    for number in range(int(seconds / PERIOD_S)):
        board_us = PERIOD_US * (number + 1)
        sent_s = start_s + board_us * 1e-6 / CLOCK_RATIO
        arrival_s = sent_s + 0.001 + random.exponential(0.003)
        if (sent_s - start_s) % STALL_INTERVAL_S > STALL_BEGIN_S:
            arrival_s = start_s + STALL_INTERVAL_S * np.ceil((sent_s - start_s) / STALL_INTERVAL_S)
        last_read_s = max(last_read_s, BATCH_S * np.ceil(arrival_s / BATCH_S))
        yield last_read_s, encode_sample(number, board_us)


def decoder_after(*reads: Iterator[Read]) -> FrameDecoder:
    """Return a decoder that has received the given reads, one iterator after the other."""
    decoder = FrameDecoder()
    for arrival_s, data in itertools.chain(*reads):
        decoder.feed(arrival_s, data)
    return decoder


def measured_ppm(decoder: FrameDecoder | Replay) -> float:
    """Return the rate error [ppm] after a check that it has been measured."""
    assert decoder.clock_ppm is not None
    return decoder.clock_ppm


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("seconds", [90.0, 600.0, 1500.0])
def test_fast_clock_is_measured_despite_delays(seconds: float, seed: int) -> None:
    decoder = decoder_after(generate_reads(seconds, seed=seed))
    assert measured_ppm(decoder) == pytest.approx(CLOCK_PPM, abs=TOLERANCE_PPM)


def test_rate_error_is_unknown_in_the_first_minute() -> None:
    assert decoder_after(generate_reads(55.0)).clock_ppm is None
    assert FrameDecoder().clock_ppm is None


def test_rate_error_is_unknown_if_all_samples_arrive_together() -> None:
    decoder = FrameDecoder()
    decoder.feed(START_S, b"".join(data for _, data in generate_reads(90.0)))
    assert decoder.clock_ppm is None


def test_implausible_rate_error_is_not_reported() -> None:
    """The host's clock advances only 0.9 s in one second."""
    reads_with_slow_host_clock = (
        (START_S + 0.9 * (arrival_s - START_S), data) for arrival_s, data in generate_reads(120.0)
    )
    assert decoder_after(reads_with_slow_host_clock).clock_ppm is None


def test_rate_error_is_measured_from_the_start_after_a_board_reset() -> None:
    reset_s = START_S + 300.0
    soon_after_reset = decoder_after(generate_reads(120.0), generate_reads(50.0, boot_id=2, start_s=reset_s))
    assert soon_after_reset.clock_ppm is None
    long_after_reset = decoder_after(generate_reads(120.0), generate_reads(120.0, boot_id=2, start_s=reset_s))
    assert measured_ppm(long_after_reset) == pytest.approx(CLOCK_PPM, abs=TOLERANCE_PPM)


def test_rate_error_is_the_same_after_an_outage() -> None:
    received = (read for read in generate_reads(300.0) if not 60.0 < read[0] - START_S < 200.0)
    assert measured_ppm(decoder_after(received)) == pytest.approx(CLOCK_PPM, abs=TOLERANCE_PPM)


SetClock = Callable[[int, int], int]
"""Function of sample number and true time stamp [us] that returns the time stamp that the board sends [us]."""


def encode_with_clock(number: int, set_clock: SetClock) -> bytes:
    """Return a sample of a board whose 32-bit clock is changed by ``set_clock``."""
    return encode_sample(number, set_clock(number, PERIOD_US * (number + 1)) % 2**32)


def decoder_with_clock(set_clock: SetClock, seconds: int = 60) -> FrameDecoder:
    """Return a decoder that has received 10 Hz samples without delay. ``set_clock`` gives their time stamps."""
    decoder = FrameDecoder()
    decoder.feed(START_S, HELLO)
    for number in range(round(seconds / PERIOD_S)):
        decoder.feed(START_S + PERIOD_S * (number + 1), encode_with_clock(number, set_clock))
    return decoder


@pytest.mark.parametrize(
    ("set_clock", "min_jumps", "max_jumps"),
    [
        (lambda number, us: us + (3_000_000_000 if number == 300 else 0), 2, 2),
        (lambda number, us: us + (3_000_000_000 if number >= 300 else 0), 1, 1),
        (lambda number, us: us - (20_000_000 if number >= 300 else 0), 1, 1),
        # Knuth's multiplicative hash gives random time stamps, of which a few are plausible by chance.
        (lambda number, us: us if not 300 <= number < 330 else 2_654_435_761 * (number + 1), 3, 40),
    ],
    ids=["one ahead", "ahead from now on", "back", "at random for 3 s"],
)
def test_jump_of_the_clock_is_rejected(set_clock: SetClock, min_jumps: int, max_jumps: int) -> None:
    """Sample times then follow the arrival times, so that no charge is integrated over time that did not pass."""
    decoder = decoder_with_clock(set_clock)
    last_sample = decoder.feed(START_S + 60.1, encode_with_clock(600, set_clock))  # follows 600 samples
    assert last_sample["time_s"][0] == pytest.approx(60.0, abs=1e-3)
    assert min_jumps <= decoder.counters.clock_jumps <= max_jumps


def test_clock_jitter_does_not_accumulate() -> None:
    """The clock runs ahead by up to 80 % of ``MAX_LEAD_S``, and the time error at the end is at most ``MAX_LEAD_S``."""
    jitter_step_us = round(0.2e6 * MAX_LEAD_S)

    def add_jitter(number: int, us: int) -> int:
        steps = -number % 5 if 100 <= number < 500 else 0  # the remainder is 0, 4, 3, 2, 1, 0, 4, ...
        return us + jitter_step_us * steps

    decoder = decoder_with_clock(add_jitter)
    last_sample = decoder.feed(START_S + 60.1, encode_with_clock(600, add_jitter))
    assert decoder.counters.clock_jumps > 50
    assert last_sample["time_s"][0] == pytest.approx(60.0, abs=MAX_LEAD_S)


def test_clock_that_is_ahead_by_40_minutes_after_a_reset_is_rejected() -> None:
    decoder = decoder_with_clock(lambda _, us: us)
    decoder.feed(START_S + 70.0, encode_hello(boot_id=99))
    block = decoder.feed(START_S + 70.0, encode_sample(0, 2_400_000_000))
    assert block["time_s"].tolist() == pytest.approx([69.9])  # the first sample, at 0.1 s, has time 0
    assert decoder.counters.clock_jumps == 1


def test_clock_set_back_during_an_outage_is_rejected() -> None:
    """The sequence numbers show a loss of 100 s, but the board's clock advances by 20 s. No hello reports a reset."""
    decoder = FrameDecoder()
    decoder.feed(START_S, encode_hello(period_ns=1000 * PERIOD_US))
    outage_end, clock_error_us = 1300, 80_000_000
    times_s: list[float] = []
    for number in (*range(300), *range(outage_end, 1400)):
        board_us = PERIOD_US * (number + 1) - (clock_error_us if number >= outage_end else 0)
        block = decoder.feed(START_S + PERIOD_S * (number + 1), encode_sample(number, board_us))
        times_s.extend(block["time_s"])
    assert times_s[-1] == pytest.approx(139.9)  # the first sample, at 0.1 s, has time 0
    assert decoder.counters.clock_jumps == 1


def test_board_clock_is_used_after_a_host_stall() -> None:
    """After the stall the buffered samples arrive together. The samples that overflowed the buffer are missing."""
    decoder = FrameDecoder()
    decoder.feed(START_S, encode_hello(period_ns=1000 * PERIOD_US))
    frames = [encode_sample(number, PERIOD_US * (number + 1)) for number in range(901)]
    for number in range(300):
        decoder.feed(START_S + PERIOD_S * (number + 1), frames[number])
    decoder.feed(START_S + 90.0, b"".join(frames[300:450]))
    last_sample = decoder.feed(START_S + 90.1, frames[900])
    assert decoder.counters.clock_jumps == 0
    assert last_sample["time_s"][0] == pytest.approx(90.0)


def test_sample_times_follow_the_clock_of_the_board() -> None:
    decoder = FrameDecoder()
    time_s = np.concatenate([decoder.feed(*read)["time_s"] for read in generate_reads(90.0)])
    assert np.array_equal(time_s, 1e-6 * (PERIOD_US * np.arange(900)))


async def test_replay_measures_the_same_rate_error_bit_for_bit(tmp_path: Path) -> None:
    reads = list(generate_reads(90.0))
    with CaptureWriter(tmp_path / "line.bms", CaptureHeader()) as writer:
        for read in reads:
            writer.write(*read)
    replay = Replay(RawCapture(tmp_path / "line.bms"))
    async for _ in replay:
        pass
    assert measured_ppm(replay) == measured_ppm(decoder_after(iter(reads)))


def test_clock_kernels_are_compiled_before_samples_arrive() -> None:
    program = """
from bms_estimator.protocols.firmware.clock_drift import clock_ppm
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
FrameDecoder()
assert clock_ppm.signatures
"""
    subprocess.run([sys.executable, "-c", program], check=True)
