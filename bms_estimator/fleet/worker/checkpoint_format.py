"""A partition as bytes, from which another worker continues.

Layout, little-endian::

    0  magic    8s   b"BMSFLEET"
    8  format   u2   1
    10 length   u4   of the header
    14 crc      u4   CRC-32 of the header
    18 header        JSON: partition, sequence, counters, spans of packs that wait, layouts of records, entries
    .. chunks        length u4, CRC-32 u4, entries; the last has length 0

    entry:  layout u1, length of the name u2, of the data u4, name, data

A layout names each field of a record, so that a version with other fields can take the state over. Layout 255 is a
block that an earlier version stored here for an unknown pack: this pack's messages are read from the stream again.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.fleet.worker.deferred import Span
from bms_estimator.fleet.worker.pack_state import PACK_STATE
from bms_estimator.kernels.packed_record import symmetry_map

FORMAT = 1
CHUNK_BYTES = 1 << 20
_HEAD, _CHUNK, _ENTRY = struct.Struct("<8sHII"), struct.Struct("<II"), struct.Struct("<BHI")
_MAGIC, _FORMER_BLOCK, _MAX_LAYOUTS = b"BMSFLEET", 255, 255
_MAX_RECORD = 1 << 24


class CheckpointError(ValueError):
    """Error in a checkpoint, and what can be done."""


class PreviousLayoutState(NamedTuple):
    """A pack's state as another version left it."""

    layout: str
    packed: bytes


def layout_of(dtype: np.dtype[Any]) -> str:
    """Return the fields of a record as text."""
    return json.dumps(_described(dtype), separators=(",", ":"))


def dtype_of(layout: str) -> np.dtype[Any]:
    """Return the dtype that ``layout_of`` describes.

    Raises:
        ValueError: It describes none.
    """
    try:
        dtype = np.dtype(_fields(json.loads(layout)))
    except (TypeError, KeyError, IndexError, RecursionError, OverflowError) as error:
        raise ValueError(f"no layout of a record: {error}") from None
    if dtype.itemsize > _MAX_RECORD:
        raise ValueError(f"{dtype.itemsize} bytes: no layout of a pack's record")
    symmetry_map(dtype)  # rejects data that are not whole words
    return dtype


def _described(dtype: np.dtype[Any]) -> list[Any]:
    return [
        [name, _described(part) if part.names else part.base.str, list(part.shape)]
        for name, (part, *_) in (dtype.fields or {}).items()
    ]


def _fields(described: Any) -> list[Any]:
    return [(name, _fields(part) if isinstance(part, list) else part, tuple(shape)) for name, part, shape in described]


PRESENT = layout_of(PACK_STATE)


@dataclass(frozen=True)
class PartitionCheckpoint:
    """A partition at one moment.

    Attributes:
        number: Number of the partition.
        sequence: Stream sequence of the last included message.
        counters: Counts by name.
        packs: Packed records by pack, of this version's layout.
        former: Records of packs by another version.
        deferred: Messages of packs that wait, in the order of their turns.
    """

    number: int
    sequence: int
    counters: Mapping[str, int] = field(default_factory=dict)
    packs: Mapping[str, bytes] = field(default_factory=dict)
    former: Mapping[str, PreviousLayoutState] = field(default_factory=dict)
    deferred: Mapping[str, Span] = field(default_factory=dict)

    def chunks(self) -> Iterator[bytes]:
        """Yield the checkpoint's bytes in chunks of about ``CHUNK_BYTES``."""
        layouts = list(dict.fromkeys([PRESENT, *(each.layout for each in self.former.values())]))[:_MAX_LAYOUTS]
        header = {
            "partition": self.number,
            "sequence": self.sequence,
            "counters": dict(self.counters),
            "deferred": dict(self.deferred),
            "layouts": [json.loads(layout) for layout in layouts],
            "entries": len(self.packs) + len(self.former),
        }
        text = json.dumps(header, separators=(",", ":")).encode()
        chunk = [_HEAD.pack(_MAGIC, FORMAT, len(text), zlib.crc32(text)), text]
        entries: list[bytes] = []
        size = 0
        for entry in self._entries(layouts):
            entries.append(entry)
            size += len(entry)
            if size >= CHUNK_BYTES:
                yield b"".join([*chunk, *_sealed(entries)])
                chunk, entries, size = [], [], 0
        yield b"".join([*chunk, *(_sealed(entries) if entries else ()), _CHUNK.pack(0, 0)])

    def _entries(self, layouts: list[str]) -> Iterator[bytes]:
        places = {layout: place for place, layout in enumerate(layouts)}
        for pack, packed in self.packs.items():
            yield _entry(places[PRESENT], pack, packed)
        for pack, former in self.former.items():
            yield _entry(places[former.layout], pack, former.packed)


def _entry(layout: int, pack: str, data: bytes) -> bytes:
    name = pack.encode()
    return _ENTRY.pack(layout, len(name), len(data)) + name + data


def _sealed(entries: list[bytes]) -> tuple[bytes, bytes]:
    content = b"".join(entries)
    return _CHUNK.pack(len(content), zlib.crc32(content)), content


def read_checkpoint(data: bytes) -> PartitionCheckpoint:
    """Read a whole checkpoint written by ``PartitionCheckpoint.chunks``.

    Raises:
        CheckpointError: It is damaged, not a checkpoint, or of an unknown version.
    """
    try:
        return _read(memoryview(data))
    except (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"a checkpoint of {len(data)} bytes is damaged: {error}") from None


def _read(data: memoryview) -> PartitionCheckpoint:
    magic, version, length, crc = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise CheckpointError("these bytes do not begin as a checkpoint does")
    if version != FORMAT:
        raise CheckpointError(
            f"the checkpoint is of format {version}, this version reads {FORMAT}: start the version that wrote it, "
            "or begin anew from the stream"
        )
    at = _HEAD.size + length
    header = json.loads(_checked(data[_HEAD.size : at], length, crc))
    layouts = [json.dumps(layout, separators=(",", ":")) for layout in header["layouts"]]
    for layout in layouts:
        if layout != PRESENT:
            dtype_of(layout)
    packs: dict[str, bytes] = {}
    former: dict[str, PreviousLayoutState] = {}
    sequence = int(header["sequence"])
    deferred = {str(pack): Span(int(first), int(last)) for pack, (first, last) in header.get("deferred", {}).items()}
    entries = 0
    for place, pack, content in _entries_of(data, at):
        entries += 1
        if place == _FORMER_BLOCK:
            deferred[pack] = Span(1, sequence)
        elif layouts[place] == PRESENT:
            packs[pack] = content
        else:
            former[pack] = PreviousLayoutState(layouts[place], content)
    if entries != header["entries"]:
        raise CheckpointError(f"the checkpoint is damaged: {entries} of {header['entries']} entries")
    counters = {str(name): int(count) for name, count in header["counters"].items()}
    return PartitionCheckpoint(int(header["partition"]), sequence, counters, packs, former, deferred)


def _entries_of(data: memoryview, at: int) -> Iterator[tuple[int, str, bytes]]:
    while True:
        length, crc = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size
        if length == 0:
            if at != len(data) or crc:
                raise CheckpointError(f"the checkpoint is damaged: its end is at {at} of {len(data)} bytes")
            return
        chunk = _checked(data[at : at + length], length, crc)
        at += length
        place = 0
        while place < length:
            layout, of_name, of_data = _ENTRY.unpack_from(chunk, place)
            place += _ENTRY.size
            name, content = chunk[place : place + of_name], chunk[place + of_name : place + of_name + of_data]
            place += of_name + of_data
            yield layout, str(name, "utf-8"), bytes(content)


def _checked(part: memoryview, length: int, crc: int) -> bytes:
    if len(part) != length or zlib.crc32(part) != crc:
        raise CheckpointError(
            f"the checkpoint is damaged: {len(part)} of {length} bytes, or not those that were written"
        )
    return bytes(part)
