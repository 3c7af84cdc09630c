"""The bytes of a block."""

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
    rows = np.zeros(count, dtype=SAMPLE)
    rows["time_s"] = 1e7 + np.arange(count) / 3.0
    rows["voltage_v"], rows["temperature_c"] = 13.3, np.nan
    return rows


BLOCK = Block(1_700_000_000_000_000_000, 7, 3, 1.7e9, samples())


@given(
    hnp.arrays(
        SAMPLE,
        st.integers(1, 20),
        elements=st.tuples(*(st.floats(width=64) for _ in range(4)), st.integers(0, 2**32 - 1)),
    )
)
def test_every_bit_of_a_sample_comes_through(rows: SampleBlock) -> None:
    came = decode(encode(Block(1, 1, 1, 0.0, rows))).samples
    for name in SAMPLE.names or ():
        assert came[name].tobytes() == rows[name].tobytes()


def test_its_header_comes_through() -> None:
    came = decode(encode(BLOCK))
    assert (came.store, came.number, came.oldest, came.arrival_s) == (BLOCK.store, 7, 3, 1.7e9)


def test_a_minute_at_an_even_pace_is_small() -> None:
    assert len(encode(BLOCK)) < 200


@pytest.mark.parametrize("count", [0, MAX_SAMPLES + 1])
def test_no_block_is_empty_or_too_long(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count} samples in a block"):
        encode(Block(1, 1, 1, 0.0, samples(count)))


@given(st.binary(max_size=200))
def test_bytes_that_are_no_block_are_refused(data: bytes) -> None:
    for one in (data, b"BMSB" + data, encode(BLOCK)[:40] + data):
        with pytest.raises(BlockError):
            decode(one)


@given(st.integers(0), st.integers(1, 255))
def test_a_damaged_block_is_refused_or_of_the_same_size(place: int, change: int) -> None:
    data = bytearray(encode(BLOCK))
    data[place % len(data)] ^= change
    with contextlib.suppress(BlockError):
        assert decode(bytes(data)).samples.size == BLOCK.samples.size


def test_what_follows_a_block_is_refused() -> None:
    with pytest.raises(BlockError, match="not that of 60 samples"):
        decode(encode(BLOCK) + b"more")


def test_a_body_that_would_fill_the_memory_is_not_unpacked() -> None:
    header = encode(BLOCK)[:40]
    with pytest.raises(BlockError, match="not that of 60 samples"):
        decode(header + zlib.compress(bytes(50_000_000)))


@pytest.mark.parametrize(
    ("store", "number", "oldest", "arrival_s"),
    [(0, 1, 1, 0.0), (1, 0, 0, 0.0), (1, 2, 3, 0.0), (1, 2**63, 1, 0.0), (1, 1, 0, 0.0), (1, 1, 1, np.nan)],
)
def test_numbers_that_cannot_be_are_refused(store: int, number: int, oldest: int, arrival_s: float) -> None:
    header = struct.pack("<4sBxHQQQd", b"BMSB", 1, 60, store, number, oldest, arrival_s)
    with pytest.raises(BlockError, match="cannot be"):
        decode(header + encode(BLOCK)[40:])


def test_a_later_version_is_refused_by_its_number() -> None:
    data = bytearray(encode(BLOCK))
    data[4] = 2
    with pytest.raises(BlockError, match="version 2; this program reads version 1"):
        decode(bytes(data))
