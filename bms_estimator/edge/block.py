"""Binary format of a block: a header and a pack's samples of about a minute, compressed without loss.

Layout, little-endian::

    0  magic   4s  b"BMSB"
    4  version u1  1
    5  -       u1  0
    6  count   u2  samples, 1..65535
    8  store   u8  creation time of the edge's store [ns since 1970]; a later store replaces an earlier one
    16 number  u8  number of this block in its store, from 1
    24 oldest  u8  oldest number that the edge can still send; missing blocks before it will never arrive
    32 arrival f8  wall clock at the arrival of the last sample [s since 1970]
    40 body        zlib of the columns time_s, current_a, voltage_v, temperature_c (f8), status (u4)

``time_s`` is the edge's clock: seconds since the creation of its store, never decreasing within a store. Its bits are
written as differences of 64-bit integers. At a constant sample period nearly all differences are equal, which
compresses well.
"""

import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import SAMPLE, SampleBlock

_HEADER = struct.Struct("<4sBxHQQQd")
_OLDEST_OFFSET = 24
"""Offset of the field ``oldest`` in the header [bytes]."""
_MAGIC, _VERSION = b"BMSB", 1
MAX_SAMPLES = 65_535
"""Maximum number of samples of a block."""
MAX_NUMBER = 2**63
"""Exclusive upper limit of creation times of stores [ns since 1970] and of block numbers, so that both fit a signed
64-bit integer."""
_COLUMNS = tuple((name, np.dtype(SAMPLE[name]).newbyteorder("<")) for name in SAMPLE.names or ())
_SAMPLE_BYTES = sum(dtype.itemsize for _, dtype in _COLUMNS)


class BlockError(ValueError):
    """Error in the bytes of a block."""


@dataclass(frozen=True, eq=False)
class Block:
    """Block of samples, sent in one message.

    Attributes:
        store_created_ns: Creation time of the edge's store, from which timestamps count [ns since 1970].
        number: Number of this block in its store, from 1.
        oldest: Oldest number that the edge can still send; at most ``number``.
        arrival_s: Wall clock at the arrival of the last sample [s since 1970].
        samples: Shape (n,), dtype ``SAMPLE``, 1 to ``MAX_SAMPLES`` of them.
    """

    store_created_ns: int
    number: int
    oldest: int
    arrival_s: float
    samples: SampleBlock


def encode(block: Block) -> bytes:
    """Encode a block.

    Raises:
        ValueError: The block holds no sample, or more than ``MAX_SAMPLES``.
    """
    if not 1 <= block.samples.size <= MAX_SAMPLES:
        raise ValueError(f"{block.samples.size} samples in a block: must be 1 to {MAX_SAMPLES}")
    header = _HEADER.pack(
        _MAGIC, _VERSION, block.samples.size, block.store_created_ns, block.number, block.oldest, block.arrival_s
    )
    columns = [np.ascontiguousarray(block.samples[name], dtype=dtype) for name, dtype in _COLUMNS]
    columns[0] = _differences(columns[0].view("<u8"))
    return header + zlib.compress(b"".join(column.tobytes() for column in columns))


def with_oldest(data: bytes, oldest: int) -> bytes:
    """Return an encoded block with another ``oldest``."""
    return data[:_OLDEST_OFFSET] + oldest.to_bytes(8, "little") + data[_OLDEST_OFFSET + 8 :]


def decode(data: bytes) -> Block:
    """Decode a block.

    Raises:
        BlockError: The bytes are not a block, or damaged.
    """
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        raise BlockError(f"{len(data)} bytes without the header of a block")
    _, version, count, store, number, oldest, arrival_s = _HEADER.unpack_from(data)
    if version != _VERSION:
        raise BlockError(f"version {version}; this program reads version {_VERSION}")
    if not (1 <= oldest <= number < MAX_NUMBER and 0 < store < MAX_NUMBER and math.isfinite(arrival_s)):
        raise BlockError(f"implausible header: store {store}, number {number}, oldest {oldest}, arrival {arrival_s}")
    return Block(store, number, oldest, arrival_s, _decode_samples(data[_HEADER.size :], count))


def peek_header(data: bytes) -> tuple[int, float]:
    """Return the number of samples and the arrival time of the last one [s since 1970] from a block's header.

    Return 0 and infinity for bytes that are not a block.
    """
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        return 0, math.inf
    _, _, count, *_, arrival_s = _HEADER.unpack_from(data)
    return count, arrival_s if math.isfinite(arrival_s) else math.inf


def _decode_samples(body: bytes, count: int) -> SampleBlock:
    size = count * _SAMPLE_BYTES
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(body, size + 1)  # one byte more shows that the body is too long
    except zlib.error as error:
        raise BlockError(str(error)) from None
    if len(raw) != size or count == 0 or not unpacker.eof or unpacker.unused_data:
        raise BlockError(f"the body does not hold {count} samples")
    samples = np.zeros(count, dtype=SAMPLE)
    offset = 0
    for name, dtype in _COLUMNS:
        samples[name] = np.frombuffer(raw, dtype, count, offset)
        offset += count * dtype.itemsize
    samples["time_s"] = np.cumsum(samples["time_s"].view("u8"), dtype="u8").view("f8")
    return samples


def _differences(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    return np.diff(values, prepend=values.dtype.type(0))
