"""Packed records: packing is lossless, and invalid bytes are rejected."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.packed_record import WORD_BITS, pack, packed_buffer, symmetry_map, unpack
from bms_estimator.kernels.records import ESTIMATOR_STATE
from bms_estimator.model.cell import load_cell
from tests.estimator.simulated_cell import pulses

LAYOUT = np.dtype(
    [("count", "i8"), ("part", [("matrix", "f8", (2, 5, 5)), ("row", "f8", 7)]), ("end", "f8"), ("long", "u8", 40)]
)
MIRROR = symmetry_map(LAYOUT)
SIZE = MIRROR.size
BITMAP = -(-SIZE // WORD_BITS)
words_of = hnp.arrays(np.uint64, SIZE, elements=st.sampled_from([0, 1, 2**63, 2**64 - 1]))


def packed(words, mirror=MIRROR):
    out = packed_buffer(words.size)
    return out[: pack(words, mirror, out)].copy()


def test_words_below_a_diagonal_map_to_words_above() -> None:
    record = np.zeros(1, LAYOUT)
    words = record.view(np.uint64)
    words[:] = np.arange(SIZE)
    for matrix in record["part"]["matrix"][0].view(np.uint64):
        for row, column in np.ndindex(5, 5):
            below = row > column
            assert MIRROR[matrix[row, column]] == (matrix[column, row] if below else -1)
    assert np.count_nonzero(MIRROR >= 0) == 2 * 10


@given(words_of)
def test_packing_is_lossless(words) -> None:
    back = np.full_like(words, 77)
    assert unpack(packed(words), MIRROR, back)
    assert (back == words).all()


@given(words_of)
def test_a_symmetric_matrix_is_stored_once(words) -> None:
    record = words.view(LAYOUT)
    for matrix in record["part"]["matrix"][0]:
        matrix[...] = np.triu(matrix) + np.triu(matrix, 1).T
    assert packed(words).size <= BITMAP + SIZE - 20


@given(words_of, st.data())
def test_truncated_or_lengthened_data_are_rejected(words, data) -> None:
    whole = packed(words)
    back = np.zeros_like(words)
    assert not unpack(whole[: data.draw(st.integers(0, whole.size - 1))], MIRROR, back)
    assert not unpack(np.append(whole, np.uint64(5)), MIRROR, back)


@given(words_of, st.integers(0, BITMAP * WORD_BITS - 1))
def test_a_flipped_bit_of_the_bitmap_is_rejected(words, bit: int) -> None:
    whole = packed(words)
    whole[bit // WORD_BITS] ^= np.uint64(1 << bit % WORD_BITS)
    assert not unpack(whole, MIRROR, np.zeros_like(words))


@given(hnp.arrays(np.uint64, st.integers(0, SIZE + 9)))
def test_random_bytes_are_rejected_or_canonical(noise) -> None:
    """Bytes that are accepted are the unique encoding of their record."""
    back = np.zeros(SIZE, np.uint64)
    if unpack(noise, MIRROR, back):
        assert (packed(back) == noise).all()


@pytest.mark.parametrize(
    "dtype", [np.dtype([("a", "f8"), ("b", "i4")]), np.dtype([("a", "i1"), ("b", "f8")], align=True)]
)
def test_a_record_without_whole_words_is_rejected(dtype) -> None:
    with pytest.raises(ValueError, match="word"):
        symmetry_map(dtype)


def test_a_converged_estimator_packs_to_a_fifth_of_its_record() -> None:
    estimator = Estimator(load_cell("ncr18650"))
    estimator.run(pulses(hours=1.0)[0])
    assert estimator.record["filter"]["count"] == 1
    words, mirror = estimator.record.view(np.uint64), symmetry_map(ESTIMATOR_STATE)
    kept = packed(words, mirror)
    assert kept.nbytes < ESTIMATOR_STATE.itemsize / 5
    back = np.ones_like(words)
    assert unpack(kept, mirror, back)
    assert (back == words).all()
