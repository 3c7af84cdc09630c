"""Decoder of the firmware protocol with arbitrary bytes, compared with a simple, independent decoder."""

import binascii
import itertools
import struct

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings, strategies as st

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.protocols.firmware.frame_decoder import FrameCounters, FrameDecoder
from bms_estimator.protocols.firmware.messages import Hello, SampleMessage, seal
from tests.protocols.firmware.board_messages import HELLO, NTC_STATUS, encode_hello, encode_sample

MAX_PACKET = 64
"""Maximum size of a packet [bytes]. COBS adds two bytes to it."""
ERROR_COUNTERS = ("crc_errors", "cobs_errors", "length_errors", "version_errors", "type_errors")


def sample(number: int) -> bytes:
    """Return a sample at 100 Hz. Its voltage depends on the number, so that no two samples are equal."""
    return encode_sample(number, 10_000 * (number + 1), voltage_sum=34_571 + number)


NTC_SAMPLE = encode_sample(1, 20_000, aux_sum=512, status=NTC_STATUS)


def decode_independently(data: bytes) -> list[bytes]:
    """Return the packets with a valid CRC, without the CRC, decoded with the libraries cobs and binascii."""
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


def count_samples(packets: list[bytes]) -> int:
    """Return the number of packets that are samples: 22 bytes with version 1 and message type 1."""
    return sum(len(p) == 22 and p[:2] == b"\x01\x01" for p in packets)


def decode(data: bytes, cuts: list[int]) -> tuple[SampleBlock, FrameCounters]:
    """Decode ``data``, cut into chunks that arrive at one time. Return the samples and the counters."""
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
bits_by_format = {"B": 8, "H": 16, "I": 32}
hello_format = "BBBBHIIIHIBBIIIIIHIIH"
"""Format of the fields of a hello, as in module struct."""
hello_fields = [st.integers(0, 2 ** bits_by_format[code] - 1) for code in hello_format]
hellos = st.builds(Hello, *hello_fields).map(Hello.encode)
random_packets = st.binary(max_size=80).map(seal)
frames_with_a_changed_byte = st.builds(
    lambda frame, at, byte: frame[: at % len(frame)] + bytes((byte,)) + frame[at % len(frame) + 1 :],
    frames | st.just(HELLO),
    st.integers(0, 100),
    st.integers(0, 255),
)
streams = st.lists(
    st.binary(max_size=120) | frames | hellos | frames_with_a_changed_byte | random_packets | st.just(HELLO),
    max_size=12,
).map(b"".join)
cut_positions = st.lists(st.integers(0, 1000), max_size=12)


@settings(max_examples=300)
@given(streams, cut_positions)
def test_no_bytes_raise_an_error_and_chunk_boundaries_do_not_change_the_result(data: bytes, cuts: list[int]) -> None:
    whole_block, whole_counters = decode(data, [])
    cut_block, cut_counters = decode(data, cuts)
    for name in whole_block.dtype.names or ():  # the padding between the fields is not compared
        assert whole_block[name].tobytes() == cut_block[name].tobytes()
    assert whole_counters == cut_counters
    assert whole_counters.bytes_received <= len(data)


@settings(max_examples=300)
@given(streams)
def test_each_sample_with_a_valid_crc_is_decoded_or_counted_as_dropped(data: bytes) -> None:
    packets = decode_independently(HELLO + data)
    block, counters = decode(HELLO + data, [])
    assert block.size == counters.frames_received
    dropped = counters.duplicates + counters.out_of_order + counters.before_hello
    assert counters.frames_received + dropped == count_samples(packets)
    packets_of_other_versions = sum(p[0] != 1 for p in packets)
    assert counters.version_errors == packets_of_other_versions


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=200), min_size=1, max_size=8))
def test_all_frames_between_garbage_are_decoded(garbage: list[bytes]) -> None:
    data = HELLO + b"".join(noise + b"\0" + sample(i) for i, noise in enumerate(garbage))
    block, counters = decode(data, [])
    samples_in_garbage = count_samples(decode_independently(data)) - len(garbage)
    assert counters.frames_received - samples_in_garbage == len(garbage)
    assert counters.frames_lost == 0
    assert np.allclose(np.diff(block["time_s"]), 0.01)


@settings(max_examples=200)
@given(st.integers(0, 23), st.integers(1, 255))
def test_sample_with_one_changed_byte_is_rejected(at: int, change: int) -> None:
    """CRC-16 detects bursts of up to 16 bits, and a byte of a COBS frame affects at most two bytes of the packet."""
    frame = sample(1)
    changed_frame = frame[:at] + bytes((frame[at] ^ change,)) + frame[at + 1 :]
    block, counters = decode(HELLO + sample(0) + changed_frame + sample(2), [])
    first_s, last_s = block["time_s"]
    assert last_s == first_s + 0.02
    assert counters.frames_lost == 1
    assert sum(getattr(counters, name) for name in ERROR_COUNTERS) >= 1


@pytest.mark.parametrize("field", ["current_uv_per_a", "ntc_r25_ohm", "ntc_beta_k"])
def test_hello_with_a_zero_field_does_not_raise(field: str) -> None:
    decode(encode_hello(**{field: 0}) + sample(0) + NTC_SAMPLE + sample(2), [])


@given(st.binary(max_size=60))
def test_incomplete_first_frame_counts_as_no_error(data: bytes) -> None:
    """A host that opens the port while the board sends receives the end of a frame first."""
    frame_end = bytes(byte or 1 for byte in data)  # zero is the delimiter
    _, counters = decode(frame_end + b"\0" + HELLO + sample(0), [])
    assert counters.frames_received == 1
    assert not decode_independently(frame_end + b"\0")
    assert sum(getattr(counters, name) for name in ERROR_COUNTERS) == 0
