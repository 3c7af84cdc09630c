"""Tracking of the converter's reference by its bandgap, which never mixes two boards."""

import dataclasses

import numpy as np
import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import Hello, SampleMessage, unseal
from tests.protocols.firmware.test_decoder_fuzz import HELLO

BANDGAP_AT_5_V = 1.1 / 5.0 * 1024.0
BANDGAP_AT_4_V = 1.1 / 4.0 * 1024.0
READINGS = 256


def hello(bandgap: float = BANDGAP_AT_5_V, **fields: int) -> bytes:
    """Of a board whose boot readings of the bandgap had a mean of ``bandgap``."""
    sums = {"bandgap_sum": round(bandgap * READINGS), "bandgap_count": READINGS}
    return dataclasses.replace(Hello.decode(unseal(HELLO)), **(sums | fields)).encode()


def samples(count: int, rate_hz: int, bandgap: float, first: int = 0, *, ntc: bool = True) -> bytes:
    """Samples with one reading each, by turns of NTC and bandgap; above 100 Hz in one of rate / 100."""
    frames, period_us, every = [], 1_000_000 // rate_hz, max(rate_hz // 100, 1)
    for i in range(first, first + count):
        is_ntc = ntc and (i // every) % 2 == 1
        aux = 512 if is_ntc else round(bandgap)
        head = (i, period_us * (i + 1), 512 * 38, 512 * 38, 38)
        frames.append(SampleMessage(*head, aux, int(i % every == 0), 0x18 if is_ntc else 0x10).encode())
    return b"".join(frames)


@pytest.mark.parametrize("ntc", [True, False])
@pytest.mark.parametrize("rate_hz", [1, 2, 10, 50, 100, 500, 1000])
def test_a_new_supply_is_followed_within_the_same_seconds_at_every_rate(rate_hz: int, ntc: bool) -> None:
    decoder, before = FrameDecoder(), 60 * rate_hz
    decoder.feed(
        0.0, hello(channels=int(ntc), period_ns=10**9 // rate_hz) + samples(before, rate_hz, BANDGAP_AT_5_V, ntc=ntc)
    )
    was_v, after_s = decoder.reference_v, 10 if ntc else 5
    decoder.feed(60.0, samples(after_s * rate_hz, rate_hz, BANDGAP_AT_4_V, before, ntc=ntc))
    assert was_v == pytest.approx(5.0, rel=2e-3)
    followed = (1.0 / was_v - 1.0 / decoder.reference_v) / (1.0 / was_v - 1.0 / 4.0)
    assert followed == pytest.approx(1.0 - np.exp(-1.0), abs=0.1)


def test_a_board_put_in_for_another_brings_its_own_reference() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello(serial=1) + samples(1000, 100, BANDGAP_AT_5_V))
    decoder.feed(10.0, hello(BANDGAP_AT_4_V, serial=2, sequence=5000))
    assert decoder.reference_v == pytest.approx(4.0, rel=1e-3)
    assert np.isnan(decoder.feed(11.0, samples(1, 100, BANDGAP_AT_4_V, 5000))["temperature_c"][0])
    assert decoder.counters.resets == 1


def test_after_a_reset_the_reference_is_what_the_board_measured_at_it() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello() + samples(1000, 100, BANDGAP_AT_5_V))
    decoder.feed(10.0, hello(BANDGAP_AT_4_V, boot_id=257))
    assert decoder.reference_v == pytest.approx(4.0, rel=1e-3)


def test_a_hello_on_request_leaves_the_reference_as_it_is() -> None:
    decoder = FrameDecoder()
    decoder.feed(0.0, hello(BANDGAP_AT_4_V) + samples(6000, 100, BANDGAP_AT_5_V))
    was_v = decoder.reference_v
    decoder.feed(60.0, hello(BANDGAP_AT_4_V, sequence=6000))
    assert decoder.reference_v == was_v


def test_at_the_firmwares_own_rate_the_reference_is_the_same_as_ever_to_the_last_bit() -> None:
    """A mean of the last 512 readings, exponential, as the first decoder had it."""
    readings = np.random.default_rng(1).normal(BANDGAP_AT_5_V, 2.0, 2000).round()
    mean, weight = round(BANDGAP_AT_5_V * READINGS) / READINGS, float(READINGS)
    decoder = FrameDecoder()
    decoder.feed(0.0, hello())
    for i, reading in enumerate(readings):
        weight = min(weight + 1.0, 512.0)
        mean += (reading - mean) / weight
        decoder.feed(0.0, samples(2, 100, reading, 2 * i))
        assert decoder.reference_v == 1_100_000 * 1e-6 * 1024.0 / mean
