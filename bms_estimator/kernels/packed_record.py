"""Lossless packing of records without redundant 8-byte words: zeros, and lower triangles of symmetric matrices.

The packed form is a bitmap with one bit for each word, the lowest first, and the words whose bit is set. A word whose bit is
not set equals the earlier word to which the symmetry map refers, or is 0. A matrix that is not symmetric is stored in full.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.numba_cache import njit

Words = NDArray[np.uint64]
SymmetryMap = NDArray[np.int32]
"""Shape (words of a record,): index of the earlier word that each word is likely to equal; -1: likely 0."""
WORD_BYTES = 8
"""Size of a word [bytes]."""
WORD_BITS = 64
"""Size of a word [bits], and number of words that a word of the bitmap describes."""
_WORD_TYPES = "f8", "i8", "u8"
"""Data types of a word."""


@lru_cache(maxsize=64)
def symmetry_map(dtype: np.dtype[Any]) -> SymmetryMap:
    """Return the symmetry map of a record. Each word below the diagonal of a square matrix refers to the word above.

    Covariances are symmetric, so that the words below their diagonals are redundant.

    Raises:
        ValueError: A field does not consist of whole words, or the record has padding.
    """
    earlier_word = np.full(dtype.itemsize // WORD_BYTES, -1, np.int32)
    words = 0
    for first, shape in _fields(dtype, 0):
        size = math.prod(shape)
        words += size
        if len(shape) > 1 and shape[-1] == shape[-2]:
            n = shape[-1]
            index = np.arange(n * n).reshape(n, n)
            row, column = np.tril_indices(n, -1)
            for first_of_matrix in range(first, first + size, n * n):
                earlier_word[first_of_matrix + index[row, column]] = first_of_matrix + index[column, row]
    if words * WORD_BYTES != dtype.itemsize:
        raise ValueError(
            f"{dtype.itemsize - words * WORD_BYTES} bytes of the record are no words of {WORD_BYTES} bytes"
        )
    earlier_word.flags.writeable = False  # the result is cached and shared by all callers
    return earlier_word


def _fields(dtype: np.dtype[Any], offset: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the index of the first word and the shape of each field, with the fields of nested records.

    ``offset`` is the position of this record in the outermost one [bytes].

    Raises:
        ValueError: A field does not consist of whole words.
    """
    for name in dtype.names or ():
        field, offset_in_record = dtype.fields[name][:2]  # type: ignore[index]
        field_offset = offset + offset_in_record
        if field.base.names:
            for k in range(math.prod(field.shape)):
                yield from _fields(field.base, field_offset + k * field.base.itemsize)
        elif field.base.str[1:] not in _WORD_TYPES or field_offset % WORD_BYTES:
            raise ValueError(f"{name}: {field} at {field_offset} does not consist of whole words")
        else:
            yield field_offset // WORD_BYTES, field.shape


def packed_buffer(words: int) -> Words:
    """Return a buffer for the packed form of a record of ``words`` words."""
    return np.zeros(words + (words + WORD_BITS - 1) // WORD_BITS, np.uint64)


@njit(cache=True)
def pack(words: Words, earlier_word: SymmetryMap, out: Words) -> int:
    """Write a record to ``out`` without redundant words.

    Args:
        words: Shape (n,), the record's words.
        earlier_word: Symmetry map of the record's layout.
        out: Result of ``packed_buffer``; written.

    Returns:
        Number of words written to ``out``.
    """
    n = words.shape[0]
    bitmap_words = (n + WORD_BITS - 1) // WORD_BITS
    end = bitmap_words
    for b in range(bitmap_words):
        bits = np.uint64(0)
        for w in range(b * WORD_BITS, min((b + 1) * WORD_BITS, n)):
            word = words[w]
            if word != (words[earlier_word[w]] if earlier_word[w] >= 0 else np.uint64(0)):
                bits |= np.uint64(1) << np.uint64(w - b * WORD_BITS)
                out[end] = word
                end += 1
        out[b] = bits
    return end


@njit(cache=True)
def unpack(packed: Words, earlier_word: SymmetryMap, words: Words) -> bool:
    """Unpack a record into ``words``.

    Args:
        packed: Words written by ``pack``.
        earlier_word: Symmetry map of the record's layout.
        words: Shape (n,), the record's words; written.

    Returns:
        True, or False if ``packed`` does not have this layout; ``words`` are then undefined.
    """
    n = words.shape[0]
    bitmap_words = (n + WORD_BITS - 1) // WORD_BITS
    position, size = bitmap_words, packed.shape[0]
    if size < bitmap_words:
        return False
    for b in range(bitmap_words):
        bits = packed[b]
        for w in range(b * WORD_BITS, min((b + 1) * WORD_BITS, n)):
            word = words[earlier_word[w]] if earlier_word[w] >= 0 else np.uint64(0)
            if bits & np.uint64(1):
                if position == size or packed[position] == word:  # too short, or stored although it is redundant
                    return False
                word = packed[position]
                position += 1
            words[w] = word
            bits >>= np.uint64(1)
        if bits:  # set bits beyond the last word
            return False
    return position == size
