"""Checkpoint format: a partition as bytes, from which another worker continues.

Layout, little-endian::

    0  magic    8s   b"BMSFLEET"
    8  format   u2   FORMAT, or the format before it
    10 length   u4   of the header
    14 crc      u4   CRC-32 of the header
    18 header        JSON: partition, sequence, counters, spans of deferred messages, rows of the table in force, record
                     layouts, number of entries
    .. chunks        length u4, CRC-32 u4, entries; the last has length 0

    entry:  layout u1, length of the name u2, of the data u4, name, data

A version reads its own format and the format before it (``PREVIOUS``). It writes either of the two. A worker writes the
newest format that all live workers read, so that workers of two versions can take over partitions from each other. A reader of
a format that it does not know raises ``UnreadableFormatError``, and the worker then leaves the partition to others.

An entry is one pack's packed record; its layout is an index into the header's layouts. A layout names each field of a record,
so that a version with other fields can restore the state. Layout 255 is not an index: an earlier version stored blocks of
unknown packs here. The messages of such a pack are read from the stream again.
"""

import json
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.fleet.packs.table_change import PackSource
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.pack_state import PACK_STATE
from bms_estimator.kernels.packed_record import symmetry_map

Header = dict[str, Any]


class HeaderMigration(NamedTuple):
    """Conversions of a header between two successive formats. Entries need none, because layouts name their fields."""

    upgrade: Callable[[Header], Header]
    """Return a header of the older format as one of the newer format."""
    downgrade: Callable[[Header], Header]
    """Return a header of the newer format as one of the older format."""


FORMAT = 2
"""Newest format that this version reads and writes. Format 2 added the rows of the table that are in force."""
PREVIOUS: HeaderMigration | None = HeaderMigration(
    upgrade=lambda header: header | {"sources": [], "in_force": {}},
    downgrade=lambda header: {name: value for name, value in header.items() if name not in ("sources", "in_force")},
)
"""Migration between format ``FORMAT - 1`` and ``FORMAT``; None while ``FORMAT`` is the first format."""
CHUNK_BYTES = 1 << 20
"""Size at which a chunk of entries is finished [bytes]."""
_FILE_HEAD, _CHUNK_HEAD, _ENTRY_HEAD = struct.Struct("<8sHII"), struct.Struct("<II"), struct.Struct("<BHI")
_MAGIC = b"BMSFLEET"
_STORED_BLOCK = 255
"""Layout number of a block of an unknown pack, which an earlier version stored."""
_MAX_LAYOUTS = 255
"""Maximum number of layouts, whose indexes are below ``_STORED_BLOCK``."""
_MAX_RECORD_BYTES = 1 << 24
"""Maximum size of a record that a layout from a checkpoint may describe [bytes]."""


class CheckpointError(ValueError):
    """Unreadable checkpoint; the message gives the reason and a remedy."""


class UnreadableFormatError(CheckpointError):
    """Error of an intact checkpoint in a format that this version cannot read.

    Args:
        found: Format of the checkpoint; 0 if even the metadata of the checkpoint is unreadable.
    """

    def __init__(self, found: int) -> None:
        what = f"the checkpoint is of format {found}" if found else "the pointer to the checkpoints is unreadable"
        super().__init__(f"{what}, this version reads {readable_text()}: start a worker of the version that wrote it")
        self.found = found


def oldest_format() -> int:
    """Return the oldest format that this version reads and writes."""
    return FORMAT if PREVIOUS is None else FORMAT - 1


def readable_text() -> str:
    """Return the readable formats as text, such as ``1 and 2``."""
    return f"{FORMAT}" if PREVIOUS is None else f"{FORMAT - 1} and {FORMAT}"


def is_readable(found: int) -> bool:
    """Return True if this version reads a format."""
    return oldest_format() <= found <= FORMAT


def common_format(newest_formats: Iterable[int]) -> int:
    """Return the format to write: the newest one that all workers read, as far as this version writes it.

    Args:
        newest_formats: Newest format that each other worker reads.
    """
    return max(oldest_format(), min([FORMAT, *newest_formats]))


class PreviousLayoutState(NamedTuple):
    """A pack's record in the layout of another version."""

    layout: str
    packed: bytes


def layout_of(dtype: np.dtype[Any]) -> str:
    """Return the fields of a record dtype as JSON text."""
    return json.dumps(_layout_fields(dtype), separators=(",", ":"))


def dtype_of(layout: str) -> np.dtype[Any]:
    """Return the dtype that ``layout_of`` describes.

    Raises:
        ValueError: The text does not describe a record.
    """
    try:
        dtype = np.dtype(_dtype_fields(json.loads(layout)))
    except (TypeError, KeyError, IndexError, RecursionError, OverflowError) as error:
        raise ValueError(f"no layout of a record: {error}") from None
    if dtype.itemsize > _MAX_RECORD_BYTES:
        raise ValueError(f"{dtype.itemsize} bytes: no layout of a pack's record")
    symmetry_map(dtype)  # raises ValueError if the record does not consist of whole words
    return dtype


def _layout_fields(dtype: np.dtype[Any]) -> list[Any]:
    return [
        [name, _layout_fields(part.base) if part.base.names else part.base.str, list(part.shape)]
        for name, (part, *_) in (dtype.fields or {}).items()
    ]


def _dtype_fields(layout: Any) -> list[Any]:
    return [
        (name, _dtype_fields(part) if isinstance(part, list) else part, tuple(shape)) for name, part, shape in layout
    ]


CURRENT_LAYOUT = layout_of(PACK_STATE)
"""Layout of a pack's record in this version."""


@dataclass(frozen=True)
class PartitionCheckpoint:
    """Snapshot of a partition.

    Attributes:
        number: Number of the partition.
        sequence: Stream sequence number of the last included message.
        counters: Counts by name.
        packs: Packed records in this version's layout, by pack.
        unmigrated: Packed records in the layout of another version, by pack.
        deferred: Deferred messages by pack, in the order in which the packs are served.
        in_force: Row and cell file of each pack at this position of the stream, for packs with processed blocks.
    """

    number: int
    sequence: int
    counters: Mapping[str, int] = field(default_factory=dict)
    packs: Mapping[str, bytes] = field(default_factory=dict)
    unmigrated: Mapping[str, PreviousLayoutState] = field(default_factory=dict)
    deferred: Mapping[str, Span] = field(default_factory=dict)
    in_force: Mapping[str, PackSource] = field(default_factory=dict)

    def chunks(self, file_format: int | None = None) -> Iterator[bytes]:
        """Yield the checkpoint's bytes in chunks of about ``CHUNK_BYTES``.

        Args:
            file_format: Format to write, ``FORMAT`` or the one before it; None: ``FORMAT``.
        """
        file_format = file_format or FORMAT
        layouts = list(dict.fromkeys([CURRENT_LAYOUT, *(each.layout for each in self.unmigrated.values())]))[
            :_MAX_LAYOUTS
        ]
        sources = list(dict.fromkeys(self.in_force.values()))
        indexes = {source: index for index, source in enumerate(sources)}
        header: Header = {
            "partition": self.number,
            "sequence": self.sequence,
            "counters": dict(self.counters),
            "deferred": dict(self.deferred),
            "sources": sources,
            "in_force": {pack: indexes[source] for pack, source in self.in_force.items()},
            "layouts": [json.loads(layout) for layout in layouts],
            "entries": len(self.packs) + len(self.unmigrated),
        }
        if PREVIOUS and file_format < FORMAT:
            header = PREVIOUS.downgrade(header)
        text = json.dumps(header, separators=(",", ":")).encode()
        chunk = [_FILE_HEAD.pack(_MAGIC, file_format, len(text), zlib.crc32(text)), text]
        entries: list[bytes] = []
        size = 0
        for entry in self._entries(layouts):
            entries.append(entry)
            size += len(entry)
            if size >= CHUNK_BYTES:
                yield b"".join([*chunk, *_framed_chunk(entries)])
                chunk, entries, size = [], [], 0
        yield b"".join([*chunk, *(_framed_chunk(entries) if entries else ()), _CHUNK_HEAD.pack(0, 0)])

    def _entries(self, layouts: list[str]) -> Iterator[bytes]:
        indexes = {layout: index for index, layout in enumerate(layouts)}
        for pack, packed in self.packs.items():
            yield _entry(indexes[CURRENT_LAYOUT], pack, packed)
        for pack, state in self.unmigrated.items():
            yield _entry(indexes[state.layout], pack, state.packed)


def _entry(layout_index: int, pack: str, data: bytes) -> bytes:
    name = pack.encode()
    return _ENTRY_HEAD.pack(layout_index, len(name), len(data)) + name + data


def _framed_chunk(entries: list[bytes]) -> tuple[bytes, bytes]:
    content = b"".join(entries)
    return _CHUNK_HEAD.pack(len(content), zlib.crc32(content)), content


def read_checkpoint(data: bytes) -> PartitionCheckpoint:
    """Read a whole checkpoint written by ``PartitionCheckpoint.chunks``.

    Raises:
        UnreadableFormatError: The checkpoint has a format that this version cannot read.
        CheckpointError: The bytes are damaged or not a checkpoint.
    """
    try:
        return _read(memoryview(data))
    except (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"a checkpoint of {len(data)} bytes is damaged: {error}") from None


def _read(data: memoryview) -> PartitionCheckpoint:
    magic, version, length, crc = _FILE_HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise CheckpointError("not a checkpoint: its first bytes differ")
    if not is_readable(version):
        raise UnreadableFormatError(version)
    header_end = _FILE_HEAD.size + length
    header = json.loads(_verify(data[_FILE_HEAD.size : header_end], length, crc))
    if PREVIOUS and version < FORMAT:
        header = PREVIOUS.upgrade(header)
    layouts = [json.dumps(layout, separators=(",", ":")) for layout in header["layouts"]]
    for layout in layouts:
        if layout != CURRENT_LAYOUT:
            dtype_of(layout)
    packs: dict[str, bytes] = {}
    unmigrated: dict[str, PreviousLayoutState] = {}
    sequence = int(header["sequence"])
    deferred = {str(pack): Span(int(first), int(last)) for pack, (first, last) in header.get("deferred", {}).items()}
    entries = 0
    for layout_index, pack, content in _read_entries(data, header_end):
        entries += 1
        if layout_index == _STORED_BLOCK:
            deferred[pack] = Span(1, sequence)  # all messages of the pack are read from the stream again
        elif layouts[layout_index] == CURRENT_LAYOUT:
            packs[pack] = content
        else:
            unmigrated[pack] = PreviousLayoutState(layouts[layout_index], content)
    if entries != header["entries"]:
        raise CheckpointError(f"the checkpoint is damaged: {entries} of {header['entries']} entries")
    counters = {str(name): int(count) for name, count in header["counters"].items()}
    sources = [PackSource(str(row), cell if cell is None else str(cell)) for row, cell in header["sources"]]
    in_force = {str(pack): sources[index] for pack, index in header["in_force"].items()}
    return PartitionCheckpoint(int(header["partition"]), sequence, counters, packs, unmigrated, deferred, in_force)


def _read_entries(data: memoryview, offset: int) -> Iterator[tuple[int, str, bytes]]:
    """Yield layout index, pack and record of each entry; the chunks begin at ``offset``."""
    while True:
        length, crc = _CHUNK_HEAD.unpack_from(data, offset)
        offset += _CHUNK_HEAD.size
        if length == 0:
            if offset != len(data) or crc:
                raise CheckpointError(f"the checkpoint is damaged: its end is at {offset} of {len(data)} bytes")
            return
        chunk = _verify(data[offset : offset + length], length, crc)
        offset += length
        begin = 0  # of the entry in the chunk
        while begin < length:
            layout_index, name_bytes, data_bytes = _ENTRY_HEAD.unpack_from(chunk, begin)
            name_begin = begin + _ENTRY_HEAD.size
            data_begin = name_begin + name_bytes
            begin = data_begin + data_bytes
            yield layout_index, str(chunk[name_begin:data_begin], "utf-8"), bytes(chunk[data_begin:begin])


def _verify(part: memoryview, length: int, crc: int) -> bytes:
    if len(part) != length or zlib.crc32(part) != crc:
        raise CheckpointError(f"the checkpoint is damaged: {len(part)} of {length} bytes, or a wrong checksum")
    return bytes(part)
