"""Checkpoint format: a partition as bytes, from which another worker continues.

Layout, little-endian::

    0  magic    8s   b"BMSFLEET"
    8  format   u2   ``FORMAT``, or the one before it
    10 length   u4   of the header
    14 crc      u4   CRC-32 of the header
    18 header        JSON: number of the increment, partition, sequence, counters, spans of deferred messages, rows of the
                     table in force, record layouts, number of entries
    .. chunks        length u4, CRC-32 u4, entries; the last has length 0

    entry:  layout u1, length of the name u2, of the data u4, name, data

A whole checkpoint contains all packs. An increment contains only the packs that were changed since the checkpoint before it,
and a complete header. A whole checkpoint and its increments, concatenated in order, are again a checkpoint.

An entry is one pack's packed record; its layout is an index into the header's layouts. A layout names each field of a record,
so that a version with other fields can restore the state.

A version reads and writes two successive formats. A worker writes the newest format that all live workers read, so that workers
of two versions can take over partitions from each other. A reader of any other format raises ``UnreadableFormatError``, and the
worker then leaves the partition to others.
"""

import json
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from bms_estimator.fleet.packs.table_change import PackSource
from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.pack_records import CURRENT_LAYOUT, RecordWithLayout, dtype_of

Header = dict[str, Any]


class HeaderMigration(NamedTuple):
    """Conversions of a header between two successive formats. Entries need none, because layouts name their fields."""

    upgrade: Callable[[Header], Header]
    """Return a header of the older format as one of the newer format."""
    downgrade: Callable[[Header], Header]
    """Return a header of the newer format as one of the older format."""


FORMAT = 3
"""Newest format that this version reads and writes. Format 3 added increments."""
INCREMENT_FORMAT = 3
"""First format with increments."""


class CheckpointError(ValueError):
    """Unreadable checkpoint; the message gives the reason and a remedy."""


def _without_increments(header: Header) -> Header:
    """Return a header of format 3 as one of format 2."""
    return {name: value for name, value in header.items() if name != "increment"}


def _with_increments(header: Header) -> Header:
    """Return a header of format 2 as one of format 3.

    Raises:
        CheckpointError: The header is not of format 2.
    """
    if "increment" in header:
        raise CheckpointError("the checkpoint is damaged: its format is not the one of its header")
    return header | {"increment": 0}


MIGRATION = HeaderMigration(upgrade=_with_increments, downgrade=_without_increments)
"""Migration between format ``FORMAT - 1`` and ``FORMAT``."""


class UnreadableFormatError(CheckpointError):
    """Error of an intact checkpoint in a format that this version cannot read.

    Args:
        found: Format of the checkpoint; 0 if even the metadata of the checkpoint is unreadable.
    """

    def __init__(self, found: int) -> None:
        what = f"the checkpoint is of format {found}" if found else "the pointer to the checkpoints is unreadable"
        super().__init__(
            f"{what}, this version reads {FORMAT - 1} and {FORMAT}: start a worker of the version that wrote it"
        )
        self.format = found


def oldest_format() -> int:
    """Return the oldest format that this version reads and writes."""
    return FORMAT - 1


def is_readable(found: int) -> bool:
    """Return True if this version reads a format."""
    return oldest_format() <= found <= FORMAT


def common_format(newest_formats: Iterable[int]) -> int:
    """Return the newest format that this version writes and all live workers read.

    Args:
        newest_formats: Newest format that each other worker reads.
    """
    return max(oldest_format(), min([FORMAT, *newest_formats]))


CHUNK_BYTES = 1 << 20
"""Size at which a chunk of entries is finished [bytes]."""
_FILE_HEAD, _CHUNK_HEAD, _ENTRY_HEAD = struct.Struct("<8sHII"), struct.Struct("<II"), struct.Struct("<BHI")
_MAGIC = b"BMSFLEET"


@dataclass(frozen=True)
class PartitionCheckpoint:
    """Snapshot of a partition.

    Attributes:
        number: Number of the partition.
        sequence: Stream sequence number of the last included message.
        counters: Counts by name.
        packs: Packed records in this version's layout, by pack.
        other_layouts: Packed records in the layout of another version, or with single cells, by pack.
        deferred: Deferred messages by pack, in the order in which the packs are served.
        in_force: Row and cell file of each pack at this position of the stream, for packs with processed blocks.
        increment: 0 if the records of all packs are contained; otherwise the number of the increment.
        changed: Packs that have changed since the last saved checkpoint; None: unknown.
    """

    number: int
    sequence: int
    counters: Mapping[str, int] = field(default_factory=dict)
    packs: Mapping[str, bytes] = field(default_factory=dict)
    other_layouts: Mapping[str, RecordWithLayout] = field(default_factory=dict)
    deferred: Mapping[str, Span] = field(default_factory=dict)
    in_force: Mapping[str, PackSource] = field(default_factory=dict)
    increment: int = 0
    changed: Collection[str] | None = field(default=None, compare=False)

    def to_increment(self, number: int) -> "PartitionCheckpoint":
        """Return the increment with the changed packs.

        Args:
            number: Number of the increment, counted from 1 after a whole checkpoint.
        """
        changed = self.changed or ()
        return replace(
            self,
            increment=number,
            packs={pack: self.packs[pack] for pack in changed if pack in self.packs},
            other_layouts={pack: self.other_layouts[pack] for pack in changed if pack in self.other_layouts},
        )

    def with_increment(self, increment: "PartitionCheckpoint") -> "PartitionCheckpoint":
        """Return this checkpoint with the changes of the next increment."""
        packs = {pack: packed for pack, packed in self.packs.items() if pack not in increment.other_layouts}
        other_layouts = {pack: state for pack, state in self.other_layouts.items() if pack not in increment.packs}
        return replace(
            increment,
            increment=0,
            packs=packs | {**increment.packs},
            other_layouts=other_layouts | {**increment.other_layouts},
        )

    def chunks(self, file_format: int | None = None) -> Iterator[bytes]:
        """Yield the checkpoint's bytes in chunks of about ``CHUNK_BYTES``.

        Args:
            file_format: Format to write, ``FORMAT`` or the one before it; None: ``FORMAT``.
        """
        file_format = file_format or FORMAT
        layouts = list(dict.fromkeys([CURRENT_LAYOUT, *(each.layout for each in self.other_layouts.values())]))
        sources = list(dict.fromkeys(self.in_force.values()))
        indexes = {source: index for index, source in enumerate(sources)}
        header = {
            "increment": self.increment,
            "partition": self.number,
            "sequence": self.sequence,
            "counters": dict(self.counters),
            "deferred": dict(self.deferred),
            "sources": sources,
            "in_force": {pack: indexes[source] for pack, source in self.in_force.items()},
            "layouts": [json.loads(layout) for layout in layouts],
            "entries": len(self.packs) + len(self.other_layouts),
        }
        header = MIGRATION.downgrade(header) if file_format < FORMAT else header
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
        for pack, state in self.other_layouts.items():
            yield _entry(indexes[state.layout], pack, state.packed)


def _entry(layout_index: int, pack: str, data: bytes) -> bytes:
    name = pack.encode()
    return _ENTRY_HEAD.pack(layout_index, len(name), len(data)) + name + data


def _framed_chunk(entries: list[bytes]) -> tuple[bytes, bytes]:
    content = b"".join(entries)
    return _CHUNK_HEAD.pack(len(content), zlib.crc32(content)), content


def read_checkpoint(data: bytes) -> PartitionCheckpoint:
    """Read a whole checkpoint and its increments, written by ``PartitionCheckpoint.chunks`` and concatenated.

    Raises:
        UnreadableFormatError: The checkpoint has a format that this version cannot read.
        CheckpointError: The bytes are damaged or not a checkpoint.
    """
    try:
        checkpoint, offset = _read(memoryview(data))
        increments = 0
        while offset < len(data):
            increment, size = _read(memoryview(data)[offset:])
            offset, increments = offset + size, increments + 1
            if (checkpoint.increment, increment.increment) != (0, increments):
                raise CheckpointError(f"the checkpoint is damaged: increment {increments} is missing")
            checkpoint = checkpoint.with_increment(increment)
    except (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"a checkpoint of {len(data)} bytes is damaged: {error}") from None
    if checkpoint.increment:
        raise CheckpointError("the checkpoint is damaged: its packs without changes are missing")
    return checkpoint


def _read(data: memoryview) -> tuple[PartitionCheckpoint, int]:
    """Read one whole checkpoint or increment at the beginning of ``data``. Return it and its size [bytes]."""
    magic, file_format, length, crc = _FILE_HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise CheckpointError("not a checkpoint: its first bytes differ")
    if not is_readable(file_format):
        raise UnreadableFormatError(file_format)
    header_end = _FILE_HEAD.size + length
    header = json.loads(_verify(data[_FILE_HEAD.size : header_end], length, crc))
    header = MIGRATION.upgrade(header) if file_format < FORMAT else header
    layouts = [json.dumps(layout, separators=(",", ":")) for layout in header["layouts"]]
    for layout in layouts:
        if layout != CURRENT_LAYOUT:
            dtype_of(layout)
    packs: dict[str, bytes] = {}
    other_layouts: dict[str, RecordWithLayout] = {}
    entries, offset = 0, header_end
    while chunk := _read_chunk(data, offset):
        offset += _CHUNK_HEAD.size + len(chunk)
        for layout_index, pack, packed in _read_entries(chunk):
            entries += 1
            if layouts[layout_index] == CURRENT_LAYOUT:
                packs[pack] = packed
            else:
                other_layouts[pack] = RecordWithLayout(layouts[layout_index], packed)
    if entries != header["entries"]:
        raise CheckpointError(f"the checkpoint is damaged: {entries} of {header['entries']} entries")
    sources = [PackSource(str(row), cell if cell is None else str(cell)) for row, cell in header["sources"]]
    checkpoint = PartitionCheckpoint(
        number=int(header["partition"]),
        sequence=int(header["sequence"]),
        counters={str(name): int(count) for name, count in header["counters"].items()},
        packs=packs,
        other_layouts=other_layouts,
        deferred={str(pack): Span(int(first), int(last)) for pack, (first, last) in header["deferred"].items()},
        in_force={str(pack): sources[index] for pack, index in header["in_force"].items()},
        increment=int(header["increment"]),
    )
    return checkpoint, offset + _CHUNK_HEAD.size


def _read_chunk(data: memoryview, offset: int) -> bytes:
    """Return the entries of the chunk at ``offset``; the last chunk has none."""
    length, crc = _CHUNK_HEAD.unpack_from(data, offset)
    begin = offset + _CHUNK_HEAD.size
    return _verify(data[begin : begin + length], length, crc)


def _read_entries(chunk: bytes) -> Iterator[tuple[int, str, bytes]]:
    """Yield layout index, pack and record of each entry of a chunk."""
    offset = 0
    while offset < len(chunk):
        layout_index, name_bytes, data_bytes = _ENTRY_HEAD.unpack_from(chunk, offset)
        name_begin = offset + _ENTRY_HEAD.size
        data_begin = name_begin + name_bytes
        offset = data_begin + data_bytes
        yield layout_index, str(chunk[name_begin:data_begin], "utf-8"), chunk[data_begin:offset]


def _verify(part: memoryview, length: int, crc: int) -> bytes:
    if len(part) != length or zlib.crc32(part) != crc:
        raise CheckpointError(f"the checkpoint is damaged: {len(part)} of {length} bytes, or a wrong checksum")
    return bytes(part)
