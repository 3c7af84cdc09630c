"""A record without redundant words: words of 8 bytes that are 0, or equal on both sides of a diagonal.

The packed form is a bitmap with one bit for each word, the lowest first, and the words whose bit is set. What the
others are
follows from ``mirror``, which is of the layout alone: a word that mirrors an earlier one is as that, any other is 0. No
bit of a record is lost, symmetric or not.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.numba_cache import njit

Words = NDArray[np.uint64]
Mirror = NDArray[np.int32]
"""Shape (words of a record,): which word each is likely to equal, an earlier one; -1: 0."""
WORD_BYTES, WORD_BITS = 8, 64
_WORDS = "f8", "i8", "u8"
"""Data types of a word."""


@lru_cache(maxsize=64)
def symmetry_map(dtype: np.dtype[Any]) -> Mirror:
    """Return which words of a record are likely equal: those below and above the diagonal of a square matrix.

    Raises:
        ValueError: Not all of its fields have whole words, without padding.
    """
    mirror = np.full(dtype.itemsize // WORD_BYTES, -1, np.int32)
    known = 0
    for first, shape in _fields(dtype, 0):
        size = math.prod(shape)
        known += size
        if len(shape) > 1 and shape[-1] == shape[-2]:
            n = shape[-1]
            place = np.arange(n * n).reshape(n, n)
            row, column = np.tril_indices(n, -1)
            for matrix in range(first, first + size, n * n):
                mirror[matrix + place[row, column]] = matrix + place[column, row]
    if known * WORD_BYTES != dtype.itemsize:
        raise ValueError(
            f"{dtype.itemsize - known * WORD_BYTES} bytes of the record are no words of {WORD_BYTES} bytes"
        )
    mirror.flags.writeable = False
    return mirror


def _fields(dtype: np.dtype[Any], offset: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """First word and shape of each field that has no fields itself.

    Raises:
        ValueError: It has no whole words, or is an array of records.
    """
    for name in dtype.names or ():
        field, at = dtype.fields[name][:2]  # type: ignore[index]
        if field.names:
            yield from _fields(field, offset + at)
        elif field.base.str[1:] not in _WORDS or (offset + at) % WORD_BYTES:
            raise ValueError(f"{name}: {field} at {offset + at} cannot be taken word by word")
        else:
            yield (offset + at) // WORD_BYTES, field.shape


def room(words: int) -> Words:
    """Return the buffer size for a packed record of that many words."""
    return np.zeros(words + (words + WORD_BITS - 1) // WORD_BITS, np.uint64)


@njit(cache=True)
def pack(words: Words, mirror: Mirror, out: Words) -> int:
    """Write a record to ``out`` without redundant words.

    Args:
        words: Shape (n,).
        mirror: Mirrored words of its layout.
        out: As ``room`` made it.

    Returns:
        How many words of ``out`` are it.
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
def unpack(packed: Words, mirror: Mirror, words: Words) -> bool:
    """Write to ``words`` the record that was packed.

    Args:
        packed: As ``pack`` left it.
        mirror: Mirrored words of its layout.
        words: Shape (n,), n words of a record.

    Returns:
        False: ``packed`` does not have this layout, and ``words`` have no meaning.
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
        if bits:  # of words that there are not
            return False
    return at == size
