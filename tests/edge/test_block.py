"""Binary format of a block."""

import contextlib
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from bms_estimator.edge.block import (
    EXTREMES,
    MAX_PROBE_SAMPLES,
    MAX_SAMPLES,
    Block,
    BlockError,
    decode,
    encode,
    peek_cells,
    peek_probes,
)
from bms_estimator.fleet.nats.streams import MAX_BLOCK_BYTES
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, SampleBlock


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
        elements=st.tuples(*(st.floats(width=64) for _ in range(6)), st.integers(0, 2**32 - 1)),
    )
)
def test_decoded_samples_equal_the_encoded_ones_bit_for_bit(rows: SampleBlock) -> None:
    decoded = decode(encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=0.0, samples=rows))).samples
    has_several_probes = bool((rows["temperature_min_c"] < rows["temperature_max_c"]).any())
    for name in SAMPLE.names or ():
        is_copy = name in EXTREMES and not has_several_probes
        assert decoded[name].tobytes() == rows["temperature_c" if is_copy else name].tobytes()


@pytest.mark.parametrize(
    ("lowest_c", "count", "cells", "version"),
    [(25.0, 60, 0, 1), (25.0, 60, 4, 2), (20.0, 60, 0, 3), (20.0, 60, 4, 3), (20.0, MAX_PROBE_SAMPLES + 1, 0, 1)],
)
def test_a_block_has_the_lowest_version_that_can_hold_it(lowest_c: float, count: int, cells: int, version: int) -> None:
    rows = samples(count)
    rows["temperature_c"] = rows["temperature_max_c"] = 25.0
    rows["temperature_min_c"] = lowest_c
    cells_v = np.full((count, cells), 3.3)
    data = encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=0.0, samples=rows, cells_v=cells_v))
    assert (data[4], peek_cells(data), peek_probes(data)) == (version, cells, version == 3)
    decoded = decode(data)
    expected_c = lowest_c if version == 3 else 25.0
    assert decoded.samples[list(EXTREMES)].tolist() == [(expected_c, 25.0)] * count
    assert decoded.cells_v.tolist() == (cells_v if cells else NO_CELLS).tolist()


def test_incompressible_samples_of_version_3_stay_below_the_servers_limit() -> None:
    rows = np.frombuffer(np.random.default_rng(1).bytes(MAX_PROBE_SAMPLES * SAMPLE.itemsize), SAMPLE).copy()
    rows["temperature_min_c"], rows["temperature_max_c"] = np.sort(rows[list(EXTREMES)].tolist()).T
    cells_v = np.random.default_rng(1).uniform(3.0, 4.0, (rows.size, 16))
    data = encode(Block(store_created_ns=1, number=1, oldest=1, arrival_s=0.0, samples=rows, cells_v=cells_v))
    assert data[4] == 3
    assert len(data) <= MAX_BLOCK_BYTES


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
    data[4] = 4  # version, after the magic bytes
    with pytest.raises(BlockError, match="version 4; this program reads versions 1 to 3: upgrade workers before edges"):
        decode(bytes(data))
