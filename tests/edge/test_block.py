"""Binary format of a block."""

import contextlib
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bms_estimator.edge.block import MAX_SAMPLES, Block, BlockError, decode, encode
from bms_estimator.model.sample import SAMPLE, SampleBlock


def samples(count: int = 60) -> SampleBlock:
    """Return samples at 3 Hz."""
    rows = np.zeros(count, dtype=SAMPLE)
    rows["time_s"] = 1e7 + np.arange(count) / 3.0
    rows["voltage_v"], rows["temperature_c"] = 13.3, np.nan
    return rows


BLOCK = Block(store_created_ns=1_700_000_000 * 10**9, number=7, oldest=3, arrival_s=1.7e9, samples=samples())
HEADER_BYTES = 40
"""Length of the header of an encoded block [bytes]."""


@given(
    hnp.arrays(
        SAMPLE,
        st.integers(1, 20),
        elements=st.tuples(*(st.floats(width=64) for _ in range(4)), st.integers(0, 2**32 - 1)),
    )
)
def test_decoded_samples_equal_the_encoded_ones_bit_for_bit(rows: SampleBlock) -> None:
    decoded = decode(encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=0.0, samples=rows))).samples
    for name in SAMPLE.names or ():
        assert decoded[name].tobytes() == rows[name].tobytes()


def test_header_is_decoded_as_it_was_encoded() -> None:
    decoded = decode(encode(BLOCK))
    assert (decoded.store_created_ns, decoded.number, decoded.oldest, decoded.arrival_s) == (
        BLOCK.store_created_ns,
        7,
        3,
        1.7e9,
    )


def test_sixty_samples_at_a_constant_period_take_less_than_200_bytes() -> None:
    assert len(encode(BLOCK)) < 200


@pytest.mark.parametrize("count", [0, MAX_SAMPLES + 1])
def test_block_without_samples_or_with_too_many_is_not_encoded(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count} samples in a block"):
        encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=0.0, samples=samples(count)))


@given(st.binary(max_size=200))
def test_invalid_bytes_are_rejected(data: bytes) -> None:
    for invalid in (data, b"BMSB" + data, encode(BLOCK)[:HEADER_BYTES] + data):
        with pytest.raises(BlockError):
            decode(invalid)


@given(st.integers(0), st.integers(1, 255))
def test_block_with_a_changed_byte_is_rejected_or_keeps_its_number_of_samples(position: int, change: int) -> None:
    data = bytearray(encode(BLOCK))
    data[position % len(data)] ^= change
    with contextlib.suppress(BlockError):
        assert decode(bytes(data)).samples.size == BLOCK.samples.size


def test_bytes_after_a_block_are_rejected() -> None:
    with pytest.raises(BlockError, match="does not hold 60 samples"):
        decode(encode(BLOCK) + b"more")


def test_data_that_decompress_to_50_mb_are_rejected() -> None:
    header = encode(BLOCK)[:HEADER_BYTES]
    with pytest.raises(BlockError, match="does not hold 60 samples"):
        decode(header + zlib.compress(bytes(50_000_000)))


@pytest.mark.parametrize(
    ("store", "number", "oldest", "arrival_s"),
    [
        pytest.param(0, 1, 1, 0.0, id="store 0"),
        pytest.param(1, 0, 0, 0.0, id="number 0"),
        pytest.param(1, 2, 3, 0.0, id="oldest after number"),
        pytest.param(1, 2**63, 1, 0.0, id="number beyond int64"),
        pytest.param(1, 1, 0, 0.0, id="oldest 0"),
        pytest.param(1, 1, 1, np.nan, id="arrival NaN"),
    ],
)
def test_implausible_header_is_rejected(store: int, number: int, oldest: int, arrival_s: float) -> None:
    version, sample_count = 1, 60
    header = struct.pack("<4sBxHQQQd", b"BMSB", version, sample_count, store, number, oldest, arrival_s)
    with pytest.raises(BlockError, match="implausible header"):
        decode(header + encode(BLOCK)[HEADER_BYTES:])


def test_block_of_a_later_version_is_rejected() -> None:
    data = bytearray(encode(BLOCK))
    data[4] = 3  # version, after the magic bytes
    with pytest.raises(BlockError, match="version 3; this program reads versions 1 to 2: upgrade workers before edges"):
        decode(bytes(data))
