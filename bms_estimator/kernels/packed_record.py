"""Lossless packing of records without redundant 8-byte words: zeros, and lower triangles of symmetric matrices.

The packed form is a bitmap with one bit for each word, the lowest first, and the words whose bit is set. A word without a
bit equals the earlier word that the symmetry map of the layout names, or is 0. A matrix that is not symmetric is stored in
full.
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
    mirror = np.full(dtype.itemsize // WORD_BYTES, -1, np.int32)
    words = 0
    for first, shape in _fields(dtype, 0):
        size = math.prod(shape)
        words += size
        if len(shape) > 1 and shape[-1] == shape[-2]:
            n = shape[-1]
            place = np.arange(n * n).reshape(n, n)
            row, column = np.tril_indices(n, -1)
            for matrix in range(first, first + size, n * n):
                mirror[matrix + place[row, column]] = matrix + place[column, row]
    if words * WORD_BYTES != dtype.itemsize:
        raise ValueError(
            f"{dtype.itemsize - words * WORD_BYTES} bytes of the record are no words of {WORD_BYTES} bytes"
        )
    mirror.flags.writeable = False
    return mirror


def _fields(dtype: np.dtype[Any], offset: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the index of the first word and the shape of each field, with the fields of nested records.

    Raises:
        ValueError: A field does not consist of whole words, or is an array of records.
    """
    for name in dtype.names or ():
        field, at = dtype.fields[name][:2]  # type: ignore[index]
        if field.names:
            yield from _fields(field, offset + at)
        elif field.base.str[1:] not in _WORD_TYPES or (offset + at) % WORD_BYTES:
            raise ValueError(f"{name}: {field} at {offset + at} does not consist of whole words")
        else:
            yield (offset + at) // WORD_BYTES, field.shape


def packed_buffer(words: int) -> Words:
    """Return a buffer for the packed form of a record of ``words`` words."""
    return np.zeros(words + (words + WORD_BITS - 1) // WORD_BITS, np.uint64)


@njit(cache=True)
def pack(words: Words, mirror: SymmetryMap, out: Words) -> int:
    """Write a record to ``out`` without redundant words.

    Args:
        words: Shape (n,).
        mirror: Symmetry map of the record's layout.
        out: Result of ``packed_buffer``; written.

    Returns:
        Number of words written to ``out``.
    """
    n = words.shape[0]
    bitmap = (n + WORD_BITS - 1) // WORD_BITS
    at = bitmap
    for b in range(bitmap):
        bits = np.uint64(0)
        for w in range(b * WORD_BITS, min((b + 1) * WORD_BITS, n)):
            word = words[w]
            if word != (words[mirror[w]] if mirror[w] >= 0 else np.uint64(0)):
                bits |= np.uint64(1) << np.uint64(w - b * WORD_BITS)
                out[at] = word
                at += 1
        out[b] = bits
    return at


@njit(cache=True)
def unpack(packed: Words, mirror: SymmetryMap, words: Words) -> bool:
    """Unpack a record into ``words``.

    Args:
        packed: Words written by ``pack``.
        mirror: Symmetry map of the record's layout.
        words: Shape (n,), the record's words; written.

    Returns:
        True, or False if ``packed`` does not have this layout; ``words`` are then undefined.
    """
    n = words.shape[0]
    bitmap = (n + WORD_BITS - 1) // WORD_BITS
    at, size = bitmap, packed.shape[0]
    if size < bitmap:
        return False
    for b in range(bitmap):
        bits = packed[b]
        for w in range(b * WORD_BITS, min((b + 1) * WORD_BITS, n)):
            word = words[mirror[w]] if mirror[w] >= 0 else np.uint64(0)
            if bits & np.uint64(1):
                if at == size or packed[at] == word:  # too short, or stored although it is redundant
                    return False
                word = packed[at]
                at += 1
            words[w] = word
            bits >>= np.uint64(1)
        if bits:  # set bits beyond the last word
            return False
    return at == size
