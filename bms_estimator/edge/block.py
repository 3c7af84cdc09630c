"""Binary format of a block: a header and a pack's samples of about a minute, compressed without loss.

Layout, little-endian::

    0  magic   4s  b"BMSB"
    4  version u1  1, or 2 with cell voltages, or 3 with several temperature probes
    5  cells   u1  number of cells whose voltages the block has, from version 2 on
    6  count   u2  samples, 1..65535
    8  store   u8  creation time of the edge's store [ns since 1970]; a later store replaces an earlier one
    16 number  u8  number of this block in its store, from 1
    24 oldest  u8  oldest number that the edge can still send; missing blocks before it will never arrive
    32 arrival f8  wall clock at the arrival of the last sample [s since 1970]
    40 body        zlib of the columns time_s, current_a, voltage_v, temperature_c (f8), status (u4), in version 3 of the
                   columns temperature_min_c, temperature_max_c (f8), and of the cell voltages (module ``cell_voltages``)

``time_s`` is the edge's clock: seconds since the creation of its store, never decreasing within a store. Its bits are
written as differences of 64-bit integers. At a constant sample period nearly all differences are equal, which
compresses well. A block has the lowest version that can hold it, because a program rejects blocks of later versions.
"""

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bms_estimator.edge import cell_voltages
from bms_estimator.model.arrays import NO_CELLS, SAMPLE, CellBlock, SampleBlock

_HEADER = struct.Struct("<4sBBHQQQd")
HEADER_BYTES = _HEADER.size
_OLDEST_OFFSET = 24
"""Offset of the field ``oldest`` in the header [bytes]."""
_VERSION_OFFSET = 4
_MAGIC = b"BMSB"
VERSION = 3
"""Newest version of the format that this program reads."""
_VERSION_WITHOUT_CELLS, _VERSION_WITH_CELLS, _VERSION_WITH_PROBES = 1, 2, 3
MAX_PROBE_SAMPLES = 4_000
"""Maximum number of samples of a block of version 3. At 52 bytes for each incompressible sample, the block stays below the
server's limit. A longer block contains only the mean temperature."""
MAX_SAMPLES = 65_535
"""Maximum number of samples of a block."""
MAX_NUMBER = 2**63
"""Exclusive upper limit of creation times of stores [ns since 1970] and of block numbers, so that both fit a signed
64-bit integer."""
EXTREMES = ("temperature_min_c", "temperature_max_c")
"""Fields of a sample that only version 3 has."""
_NAMES = tuple(name for name in SAMPLE.names or () if name not in EXTREMES)


class BlockError(ValueError):
    """Error in the bytes of a block."""


@dataclass(frozen=True, eq=False)
class BlockHeader:
    """Position of a block in the order of its edge's blocks.

    Attributes:
        store_created_ns: Creation time of the edge's store, from which timestamps count [ns since 1970].
        number: Number of this block in its store, from 1.
        oldest: Oldest number that the edge can still send; at most ``number``.
        arrival_s: Wall clock at the arrival of the last sample [s since 1970].
    """

    store_created_ns: int
    number: int
    oldest: int
    arrival_s: float


@dataclass(frozen=True, eq=False)
class Block(BlockHeader):
    """Block of samples, sent in one message.

    Attributes:
        samples: Shape (n,), dtype ``SAMPLE``, 1 to ``MAX_SAMPLES`` of them.
        cells_v: Cell voltages of the samples, shape (n, m) [V]; empty if there are none.
    """

    samples: SampleBlock
    cells_v: CellBlock = field(default_factory=lambda: NO_CELLS)


def encode(block: Block) -> bytes:
    """Encode a block.

    Raises:
        ValueError: The block holds no sample, or more than ``MAX_SAMPLES``.
    """
    if not 1 <= block.samples.size <= MAX_SAMPLES:
        raise ValueError(f"{block.samples.size} samples in a block: must be 1 to {MAX_SAMPLES}")
    cells = block.cells_v.shape[1]
    version = _lowest_version(block)
    header = _HEADER.pack(
        _MAGIC,
        version,
        cells,
        block.samples.size,
        block.store_created_ns,
        block.number,
        block.oldest,
        block.arrival_s,
    )
    columns = [np.ascontiguousarray(block.samples[name], dtype=dtype) for name, dtype in _columns(version)]
    columns[0] = np.diff(columns[0].view("<u8"), prepend=np.uint64(0))
    body = [column.tobytes() for column in columns]
    if cells:
        body.append(cell_voltages.encode_cells(block.cells_v))
    return header + zlib.compress(b"".join(body))


def _lowest_version(block: Block) -> int:
    """Return the lowest version that can hold a block."""
    lowest_c, highest_c = (block.samples[name] for name in EXTREMES)
    if block.samples.size <= MAX_PROBE_SAMPLES and (lowest_c < highest_c).any():
        return _VERSION_WITH_PROBES
    return _VERSION_WITH_CELLS if block.cells_v.shape[1] else _VERSION_WITHOUT_CELLS


def _columns(version: int) -> list[tuple[str, np.dtype[Any]]]:
    """Return the fields of a sample in blocks of a version, with their little-endian types."""
    names = _NAMES + (EXTREMES if version == _VERSION_WITH_PROBES else ())
    return [(name, SAMPLE[name].newbyteorder("<")) for name in names]


def with_oldest(data: bytes, oldest: int) -> bytes:
    """Return an encoded block with another ``oldest``."""
    return data[:_OLDEST_OFFSET] + oldest.to_bytes(8, "little") + data[_OLDEST_OFFSET + 8 :]


def decode(data: bytes) -> Block:
    """Decode a block.

    Raises:
        BlockError: The bytes are not a block, or damaged.
    """
    header, count, cells = _decode_header(data)
    samples, cells_v = _decode_body(data[HEADER_BYTES:], count, cells, _columns(data[_VERSION_OFFSET]))
    return Block(header.store_created_ns, header.number, header.oldest, header.arrival_s, samples, cells_v)


def decode_header(data: bytes) -> BlockHeader:
    """Decode only the header of a block.

    Raises:
        BlockError: The bytes are not a block, or its header is damaged.
    """
    return _decode_header(data)[0]


def _decode_header(data: bytes) -> tuple[BlockHeader, int, int]:
    """Return the header of a block, and its numbers of samples and of cells."""
    if len(data) < HEADER_BYTES or data[:4] != _MAGIC:
        raise BlockError(f"{len(data)} bytes without the header of a block")
    _, version, cells, count, store, number, oldest, arrival_s = _HEADER.unpack_from(data)
    if not _VERSION_WITHOUT_CELLS <= version <= VERSION:
        raise BlockError(
            f"version {version}; this program reads versions {_VERSION_WITHOUT_CELLS} to {VERSION}: upgrade workers before edges"
        )
    if not (1 <= oldest <= number < MAX_NUMBER and 0 < store < MAX_NUMBER and math.isfinite(arrival_s)):
        raise BlockError(f"implausible header: store {store}, number {number}, oldest {oldest}, arrival {arrival_s}")
    return BlockHeader(store, number, oldest, arrival_s), count, cells if version > _VERSION_WITHOUT_CELLS else 0


def peek_header(data: bytes) -> tuple[int, float]:
    """Return the number of samples and the arrival time of the last one [s since 1970] from a block's header.

    Return 0 and infinity for bytes that are not a block.
    """
    if len(data) < HEADER_BYTES or data[:4] != _MAGIC:
        return 0, math.inf
    _, _, _, count, *_, arrival_s = _HEADER.unpack_from(data)
    return count, arrival_s if math.isfinite(arrival_s) else math.inf


def peek_cells(data: bytes) -> int:
    """Return the number of cells whose voltages an encoded block has."""
    return data[5] if data[_VERSION_OFFSET] > _VERSION_WITHOUT_CELLS else 0


def peek_probes(data: bytes) -> bool:
    """Return True if an encoded block has the lowest and the highest of several temperature probes."""
    return data[_VERSION_OFFSET] == _VERSION_WITH_PROBES


def _decode_body(
    body: bytes, count: int, cells: int, columns: Sequence[tuple[str, np.dtype[Any]]]
) -> tuple[SampleBlock, CellBlock]:
    """Decompress and decode the samples of a block, and their cell voltages."""
    size = count * sum(dtype.itemsize for _, dtype in columns)
    max_size = size + (cell_voltages.MAX_BYTES if cells else 0)
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(body, max_size + 1)  # one byte more shows that the body is too long
    except zlib.error as error:
        raise BlockError(str(error)) from None
    is_size_plausible = size < len(raw) <= max_size if cells else len(raw) == size
    if not is_size_plausible or count == 0 or not unpacker.eof or unpacker.unused_data:
        raise BlockError(f"the body does not hold {count} samples")
    try:
        cells_v = cell_voltages.decode_cells(raw[size:], count, cells) if cells else NO_CELLS
    except ValueError as error:
        raise BlockError(str(error)) from None
    return _decode_samples(raw, count, columns), cells_v


def _decode_samples(raw: bytes, count: int, columns: Sequence[tuple[str, np.dtype[Any]]]) -> SampleBlock:
    """Decode the columns of samples."""
    samples = np.zeros(count, dtype=SAMPLE)
    offset = 0
    for name, dtype in columns:
        samples[name] = np.frombuffer(raw, dtype, count, offset)
        offset += count * dtype.itemsize
    if len(columns) == len(_NAMES):  # one probe
        samples["temperature_min_c"] = samples["temperature_max_c"] = samples["temperature_c"]
    samples["time_s"] = np.cumsum(samples["time_s"].view("u8"), dtype="u8").view("f8")
    return samples
