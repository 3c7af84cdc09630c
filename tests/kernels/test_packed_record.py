"""Packed records: packing is lossless, and invalid bytes are rejected."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.packed_record import WORD_BITS, pack, packed_buffer, symmetry_map, unpack
from bms_estimator.kernels.records import ESTIMATOR_STATE
from bms_estimator.model.cell import load_cell
from tests.estimator.simulated_cell import pulses

MATRIX_SIZE, MATRICES = 5, 2
LAYOUT = np.dtype(
    [
        ("count", "i8"),
        ("part", [("matrix", "f8", (MATRICES, MATRIX_SIZE, MATRIX_SIZE)), ("row", "f8", 7)]),
        ("end", "f8"),
        ("long", "u8", 40),
    ]
)
"""Record with two symmetric matrices between other fields, longer than one word of the bitmap covers."""
SYMMETRIC_WORDS = symmetry_map(LAYOUT)
"""For each word of a record, index of the word that is equal by symmetry, or -1."""
RECORD_WORDS = SYMMETRIC_WORDS.size
WORDS_BELOW_DIAGONALS = MATRICES * MATRIX_SIZE * (MATRIX_SIZE - 1) // 2
BITMAP_WORDS = -(-RECORD_WORDS // WORD_BITS)
"""Number of words of the bitmap at the start of packed data, rounded up."""
record_words = hnp.arrays(np.uint64, RECORD_WORDS, elements=st.sampled_from([0, 1, 2**63, 2**64 - 1]))


def pack_words(words, symmetric_words=SYMMETRIC_WORDS):
    """Return the packed form of the words of a record."""
    out = packed_buffer(words.size)
    return out[: pack(words, symmetric_words, out)].copy()


def test_each_word_below_a_diagonal_maps_to_its_mirror_image_above() -> None:
    record = np.zeros(1, LAYOUT)
    words = record.view(np.uint64)
    words[:] = np.arange(RECORD_WORDS)
    for matrix in record["part"]["matrix"][0].view(np.uint64):
        for row, column in np.ndindex(MATRIX_SIZE, MATRIX_SIZE):
            below = row > column
            assert SYMMETRIC_WORDS[matrix[row, column]] == (matrix[column, row] if below else -1)
    assert np.count_nonzero(SYMMETRIC_WORDS >= 0) == WORDS_BELOW_DIAGONALS


@given(record_words)
def test_packing_is_lossless(words) -> None:
    unpacked = np.full_like(words, 77)  # any value: unpacking must also write zeros
    assert unpack(pack_words(words), SYMMETRIC_WORDS, unpacked)
    assert (unpacked == words).all()


@given(record_words)
def test_only_one_half_of_a_symmetric_matrix_is_stored(words) -> None:
    record = words.view(LAYOUT)
    for matrix in record["part"]["matrix"][0]:
        matrix[...] = np.triu(matrix) + np.triu(matrix, 1).T
    assert pack_words(words).size <= BITMAP_WORDS + RECORD_WORDS - WORDS_BELOW_DIAGONALS


@given(record_words, st.data())
def test_truncated_or_lengthened_data_are_rejected(words, data) -> None:
    packed = pack_words(words)
    unpacked = np.zeros_like(words)
    assert not unpack(packed[: data.draw(st.integers(0, packed.size - 1))], SYMMETRIC_WORDS, unpacked)
    assert not unpack(np.append(packed, np.uint64(5)), SYMMETRIC_WORDS, unpacked)


@given(record_words, st.integers(0, BITMAP_WORDS * WORD_BITS - 1))
def test_a_flipped_bit_of_the_bitmap_is_rejected(words, bit: int) -> None:
    packed = pack_words(words)
    packed[bit // WORD_BITS] ^= np.uint64(1 << bit % WORD_BITS)
    assert not unpack(packed, SYMMETRIC_WORDS, np.zeros_like(words))


@given(hnp.arrays(np.uint64, st.integers(0, RECORD_WORDS + 9)))
def test_random_words_are_rejected_or_are_the_only_encoding_of_their_record(noise) -> None:
    unpacked = np.zeros(RECORD_WORDS, np.uint64)
    if unpack(noise, SYMMETRIC_WORDS, unpacked):
        assert (pack_words(unpacked) == noise).all()


@pytest.mark.parametrize(
    "dtype", [np.dtype([("a", "f8"), ("b", "i4")]), np.dtype([("a", "i1"), ("b", "f8")], align=True)]
)
def test_a_record_with_fields_smaller_than_a_word_is_rejected(dtype) -> None:
    with pytest.raises(ValueError, match="word"):
        symmetry_map(dtype)


def test_a_converged_estimator_packs_to_a_fifth_of_its_record() -> None:
    estimator = Estimator(load_cell("ncr18650"))
    estimator.run(pulses(hours=1.0)[0])
    assert estimator.record["filter"]["count"] == 1  # one hypothesis is left
    words, symmetric_words = estimator.record.view(np.uint64), symmetry_map(ESTIMATOR_STATE)
    packed = pack_words(words, symmetric_words)
    assert packed.nbytes < ESTIMATOR_STATE.itemsize / 5
    unpacked = np.ones_like(words)
    assert unpack(packed, symmetric_words, unpacked)
    assert (unpacked == words).all()
