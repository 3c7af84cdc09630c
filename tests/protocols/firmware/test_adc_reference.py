"""ADC reference voltage of the board, which the decoder determines from bandgap readings of this board only."""

import numpy as np
import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from tests.protocols.firmware.board_messages import NTC_STATUS, POWER_ON_STATUS, encode_hello, encode_sample

FULL_SCALE = 1024
"""ADC count of the reference voltage."""
BANDGAP_AT_5_V = 1.1 / 5.0 * FULL_SCALE
"""ADC count of the bandgap of 1.1 V at a reference of 5 V."""
BANDGAP_AT_4_V = 1.1 / 4.0 * FULL_SCALE
BOOT_READINGS = 256
"""Number of bandgap readings at boot."""
MAX_AUX_RATE_HZ = 100
"""Maximum rate of the samples with an auxiliary reading [Hz]."""
MEAN_READINGS = 512
"""Time constant of the exponential mean of the bandgap, in readings at 100 Hz."""
TIME_CONSTANT_S = 5
"""Rounded time constant of the bandgap [s]: 512 readings at 100 Hz."""
OVERSAMPLING = 38
"""Number of ADC readings in a sample."""
MID_SCALE = FULL_SCALE // 2


def hello(bandgap: float = BANDGAP_AT_5_V, **fields: int) -> bytes:
    """Return the hello of a board whose bandgap readings at boot had the mean ``bandgap`` [ADC count]."""
    sums = {"bandgap_sum": round(bandgap * BOOT_READINGS), "bandgap_count": BOOT_READINGS}
    return encode_hello(**(sums | fields))


def samples(count: int, rate_hz: int, bandgap: float, first: int = 0, *, ntc: bool = True) -> bytes:
    """Return samples with one auxiliary reading each, of the bandgap, or alternately of NTC and bandgap.

    Above 100 Hz the samples without an auxiliary reading have an ``aux_count`` of 0, so that 100 readings per second
    remain.
    """
    frames = []
    samples_per_reading = max(rate_hz // MAX_AUX_RATE_HZ, 1)
    for number in range(first, first + count):
        is_ntc = ntc and (number // samples_per_reading) % 2 == 1  # every second reading
        frames.append(
            encode_sample(
                number,
                1_000_000 // rate_hz * (number + 1),
                voltage_sum=MID_SCALE * OVERSAMPLING,
                current_sum=MID_SCALE * OVERSAMPLING,
                count=OVERSAMPLING,
                aux_sum=MID_SCALE if is_ntc else round(bandgap),
                aux_count=int(number % samples_per_reading == 0),
                status=NTC_STATUS if is_ntc else POWER_ON_STATUS,
            )
        )
    return b"".join(frames)


@pytest.mark.parametrize("ntc", [True, False])
@pytest.mark.parametrize("rate_hz", [1, 2, 10, 50, 100, 500, 1000])
def test_time_constant_of_the_reference_is_independent_of_the_sample_rate(rate_hz: int, ntc: bool) -> None:
    decoder, first_samples = FrameDecoder(), 60 * rate_hz
    decoder.feed(
        0.0,
        hello(channels=int(ntc), period_ns=10**9 // rate_hz) + samples(first_samples, rate_hz, BANDGAP_AT_5_V, ntc=ntc),
    )
    before_v = decoder.reference_v
    # With an NTC the bandgap is read half as often, and its time constant is twice as long.
    step_s = 2 * TIME_CONSTANT_S if ntc else TIME_CONSTANT_S
    decoder.feed(60.0, samples(step_s * rate_hz, rate_hz, BANDGAP_AT_4_V, first_samples, ntc=ntc))
    after_v = decoder.reference_v
    assert before_v == pytest.approx(5.0, rel=2e-3)
    # The mean of the bandgap, which is proportional to 1 / reference, responds to the step after one time constant.
    response = (1.0 / before_v - 1.0 / after_v) / (1.0 / before_v - 1.0 / 4.0)
    assert response == pytest.approx(1.0 - np.exp(-1.0), abs=0.1)


def test_reference_after_the_hello_of_another_board_is_that_of_the_hello() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello(serial=1) + samples(1000, 100, BANDGAP_AT_5_V))
    decoder.feed(10.0, hello(BANDGAP_AT_4_V, serial=2, sequence=5000))
    assert decoder.reference_v == pytest.approx(4.0, rel=1e-3)
    bandgap_sample = decoder.feed(11.0, samples(1, 100, BANDGAP_AT_4_V, first=5000))
    assert np.isnan(bandgap_sample["temperature_c"][0])  # no NTC reading of the other board has arrived
    assert decoder.counters.resets == 1


def test_reference_after_a_reset_is_that_of_the_hello() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello() + samples(1000, 100, BANDGAP_AT_5_V))
    decoder.feed(10.0, hello(BANDGAP_AT_4_V, boot_id=257))
    assert decoder.reference_v == pytest.approx(4.0, rel=1e-3)


def test_hello_without_a_reset_does_not_change_the_reference() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello(BANDGAP_AT_4_V) + samples(6000, 100, BANDGAP_AT_5_V))
    before_v = decoder.reference_v
    decoder.feed(60.0, hello(BANDGAP_AT_4_V, sequence=6000))
    assert decoder.reference_v == before_v


def test_reference_at_100_hz_is_an_exponential_mean_of_512_readings() -> None:
    """The comparison is exact, because replays of captures must not change."""
    readings = np.random.default_rng(1).normal(BANDGAP_AT_5_V, 2.0, 2000).round()
    mean, weight = round(BANDGAP_AT_5_V * BOOT_READINGS) / BOOT_READINGS, float(BOOT_READINGS)
    decoder = FrameDecoder()
    decoder.feed(0.0, hello())
    for i, reading in enumerate(readings):
        weight = min(weight + 1.0, MEAN_READINGS)
        mean += (reading - mean) / weight
        decoder.feed(0.0, samples(2, 100, reading, first=2 * i))  # the second sample reads the NTC
        assert decoder.reference_v == 1_100_000 * 1e-6 * FULL_SCALE / mean  # bandgap_uv of the hello
