"""Decoder with arbitrary bytes, compared with a slow independent one."""

import binascii
import dataclasses
import itertools
import struct

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from bms_estimator.model.sample import SampleBlock
from bms_estimator.protocols.firmware.frame_decoder import FrameCounters, FrameDecoder
from bms_estimator.protocols.firmware.messages import Hello, SampleMessage, seal, unseal

HELLO = Hello(
    *(0, 1, 0),
    reset_cause=1,
    boot_id=256,
    serial=0,
    sequence=0,
    board_us=0,
    rate_hz=100,
    period_ns=10_000_000,
    adc_bits=10,
    channels=1,
    divider_ppm=5_000_000,
    current_uv_per_a=100_000,
    current_zero_ppm=500_000,
    bandgap_uv=1_100_000,
    bandgap_sum=57_672,
    bandgap_count=256,
    ntc_series_ohm=10_000,
    ntc_r25_ohm=10_000,
    ntc_beta_k=3950,
).encode()
MAX_PACKET = 64
COUNTED = ("crc_errors", "cobs_errors", "length_errors", "version_errors", "type_errors")


def sample(i: int) -> bytes:
    return SampleMessage(i, 10_000 * (i + 1), 34_571 + i, 21_405, 38, 225, 1, 16).encode()


NTC_SAMPLE = SampleMessage(1, 20_000, 34_571, 21_405, 38, 512, 1, 0x18).encode()


def slowly(data: bytes) -> list[bytes]:
    """Packets with a right CRC, without it."""
    packets = []
    for frame in data.split(b"\0")[:-1]:
        try:
            packet = cobs.decode(frame)
        except cobs.DecodeError:
            continue
        if len(packet) >= 4 and len(frame) <= MAX_PACKET + 2:
            (crc,) = struct.unpack("<H", packet[-2:])
            if binascii.crc_hqx(packet[:-2], 0xFFFF) == crc:
                packets.append(packet[:-2])
    return packets


def samples_among(packets: list[bytes]) -> int:
    return sum(len(p) == 22 and p[:2] == b"\x01\x01" for p in packets)


def decode(data: bytes, cuts: list[int]) -> tuple[SampleBlock, FrameCounters]:
    """Samples and counters of ``data`` fed in chunks, all at one time."""
    decoder = FrameDecoder()
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    blocks = [decoder.feed(1.0, data[a:b]) for a, b in itertools.pairwise(edges)]
    return np.concatenate(blocks), decoder.counters


frames = st.builds(
    SampleMessage,
    sequence=st.integers(0, 40) | st.integers(0, 2**32 - 1),
    board_us=st.integers(0, 2**32 - 1),
    voltage_sum=st.integers(0, 2**24 - 1),
    current_sum=st.integers(0, 2**24 - 1),
    count=st.integers(0, 2**16 - 1),
    aux_sum=st.integers(0, 2**16 - 1),
    aux_count=st.integers(0, 255),
    status=st.integers(0, 255),
).map(SampleMessage.encode)
widths = {"B": 8, "H": 16, "I": 32}
numbers = [st.integers(0, 2 ** widths[code] - 1) for code in "BBBBHIIIHIBBIIIIIHIIH"]
hellos = st.builds(Hello, *numbers).map(Hello.encode)
sealed_nonsense = st.binary(max_size=80).map(seal)
damaged = st.builds(
    lambda frame, at, byte: frame[: at % len(frame)] + bytes((byte,)) + frame[at % len(frame) + 1 :],
    frames | st.just(HELLO),
    st.integers(0, 100),
    st.integers(0, 255),
)
streams = st.lists(
    st.binary(max_size=120) | frames | hellos | damaged | sealed_nonsense | st.just(HELLO), max_size=12
).map(b"".join)
cuttings = st.lists(st.integers(0, 1000), max_size=12)


@settings(max_examples=300)
@given(streams, cuttings)
def test_no_bytes_raise_and_the_division_into_reads_changes_nothing(data: bytes, cuts: list[int]) -> None:
    whole, counters = decode(data, [])
    cut, cut_counters = decode(data, cuts)
    for name in whole.dtype.names or ():  # not the padding between them
        assert whole[name].tobytes() == cut[name].tobytes()
    assert counters == cut_counters
    assert counters.bytes_received <= len(data)


@settings(max_examples=300)
@given(streams)
def test_every_frame_with_a_right_crc_is_a_sample_or_counted_and_no_other_is(data: bytes) -> None:
    packets = slowly(HELLO + data)
    block, counters = decode(HELLO + data, [])
    assert block.size == counters.frames_received
    dropped = counters.duplicates + counters.out_of_order + counters.before_hello
    assert counters.frames_received + dropped == samples_among(packets)
    foreign = sum(p[0] != 1 for p in packets)
    assert counters.version_errors == foreign


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=200), min_size=1, max_size=8))
def test_frames_between_garbage_are_all_recovered(garbage: list[bytes]) -> None:
    data = HELLO + b"".join(noise + b"\0" + sample(i) for i, noise in enumerate(garbage))
    block, counters = decode(data, [])
    assert counters.frames_received - (samples_among(slowly(data)) - len(garbage)) == len(garbage)
    assert counters.frames_lost == 0
    assert np.allclose(np.diff(block["time_s"]), 0.01)


@settings(max_examples=200)
@given(st.integers(0, 23), st.integers(1, 255))
def test_a_sample_with_one_byte_changed_is_no_sample(at: int, change: int) -> None:
    """CRC-16 finds every burst of up to 16 bits; a byte of COBS touches two bytes of the packet at most."""
    frame = sample(1)
    spoilt = frame[:at] + bytes((frame[at] ^ change,)) + frame[at + 1 :]
    block, counters = decode(HELLO + sample(0) + spoilt + sample(2), [])
    assert list(block["time_s"]) == [block["time_s"][0], block["time_s"][0] + 0.02]
    assert counters.frames_lost == 1
    assert sum(getattr(counters, name) for name in COUNTED) >= 1


@pytest.mark.parametrize("field", ["current_uv_per_a", "ntc_r25_ohm", "ntc_beta_k"])
def test_hello_with_a_zero_field_does_not_raise(field: str) -> None:
    zeroed = dataclasses.replace(Hello.decode(unseal(HELLO)), **{field: 0}).encode()
    decode(zeroed + sample(0) + NTC_SAMPLE + sample(2), [])


@given(st.binary(max_size=60))
def test_half_a_frame_at_the_start_is_no_fault(tail: bytes) -> None:
    begin = bytes(byte or 1 for byte in tail)
    _, counters = decode(begin + b"\0" + HELLO + sample(0), [])
    assert counters.frames_received == 1
    assert not slowly(begin + b"\0")
    assert sum(getattr(counters, name) for name in COUNTED) == 0
