r"""Raw captures: the bytes of a serial line with their arrival times, as the decoder saw them.

File format, version 1, numbers little-endian::

    header   8 bytes  "BMSRAW1\n"
             u32      length of the JSON that follows
             JSON     UTF-8: version, started (wall clock, ISO 8601 UTC), mode ("binary", "text" or another protocol),
                      port, baud, current_sign, address; other names are ignored
             u16      CRC-16/CCITT-FALSE of the JSON
    record   f64      arrival time [s], the very float that the decoder got
             u32      length
             bytes
             u16      CRC-16/CCITT-FALSE of the record up to here

Records follow to the end of the file, one for each read of the line. The file is only appended to, one system call
for each record. A killed recorder leaves all complete records, and an incomplete last one is ignored. A file whose
name ends in .gz is read as gzip.
"""

import binascii
import dataclasses
import gzip
import json
import os
import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from bms_estimator.model.errors import UserError
from bms_estimator.settings.polled_source import PolledSource
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.capture_records import RECORD_OVERHEAD_BYTES, split_records

MAGIC = b"BMSRAW1\n"
VERSION = 1
MAX_READ_BYTES = 1 << 20
"""A record holds no more."""
CHUNK_BYTES = 1 << 20
_HEAD = struct.Struct("<dI")
_LENGTH = struct.Struct("<I")
_CRC = struct.Struct("<H")
_MAX_HEADER_BYTES = 1 << 20


@dataclass(config=ConfigDict(strict=True, extra="ignore", frozen=True))
class _Versioned:
    """Fields of a header of any version."""

    version: int


@dataclass(config=ConfigDict(strict=True, extra="ignore", frozen=True))
class CaptureHeader:
    """Header of a recording."""

    mode: str = "binary"
    port: str = ""
    baud: int = 0
    current_sign: str = "discharge_positive"
    started: str = ""
    """Wall clock at the first byte, ISO 8601 UTC; set by the writer when empty."""
    version: int = VERSION
    address: int | None = None
    """Address of the recorded pack, if the line had several."""


_VERSIONED, _HEADER = TypeAdapter(_Versioned), TypeAdapter(CaptureHeader)


def header_of(sensor: SensorSettings, source: PolledSource | None = None) -> CaptureHeader:
    """Return the header of a capture of this board's line, or of another source's lines."""
    if source is not None:
        return CaptureHeader(sensor.protocol, source.described, 0, sensor.current_sign)
    return CaptureHeader(sensor.protocol, sensor.port, sensor.baud, sensor.current_sign, address=sensor.address)


def sensor_of(path: Path) -> SensorSettings:
    """Return the board settings of the capture ``path`` that decoding needs.

    Raises:
        UserError: As ``read_header``, or the board's protocol is unknown.
    """
    header = read_header(path)
    try:
        told = {"protocol": header.mode, "current_sign": header.current_sign, "address": header.address}
        return SensorSettings.model_validate(told)
    except ValidationError:
        raise UserError(
            f"{path}: recorded from mode {header.mode!r}, current_sign {header.current_sign!r}: "
            "this program does not know both"
        ) from None


@dataclasses.dataclass(frozen=True)
class CaptureBatch:
    """Some reads of the line, in the shape that a decoder's ``feed_reads`` takes."""

    arrivals_s: NDArray[np.float64]
    ends: NDArray[np.int64]
    data: NDArray[np.uint8]
    damaged: bool
    """The file has no readable record behind these although it has not ended."""
    unread_bytes: int = 0
    """Number of bytes at the end of the file without a whole record."""

    def __iter__(self) -> Iterator[tuple[float, bytes]]:
        """Each read: arrival [s], bytes."""
        begin = 0
        for arrival_s, end in zip(self.arrivals_s.tolist(), self.ends.tolist(), strict=True):
            yield arrival_s, self.data[begin:end].tobytes()
            begin = end


class CaptureWriter:
    """Writes a capture; a context manager.

    Args:
        path: A file that does not exist yet.
        header: Header of the capture.

    Raises:
        UserError: The file exists or cannot be made.
    """

    def __init__(self, path: Path, header: CaptureHeader) -> None:
        started = header.started or datetime.now(tz=UTC).isoformat(timespec="milliseconds")
        head = json.dumps(dataclasses.asdict(header) | {"started": started}).encode()
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except FileExistsError:
            raise UserError(f"{path}: exists already; a capture is never overwritten") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None
        self._append(MAGIC + _LENGTH.pack(len(head)) + head + _CRC.pack(binascii.crc_hqx(head, 0xFFFF)))

    def write(self, arrival_s: float, data: bytes) -> None:
        """Append one read of the line.

        Args:
            arrival_s: The very number that the decoder gets [s].
            data: The bytes, at most ``MAX_READ_BYTES``.

        Raises:
            ValueError: More bytes.
            OSError: The disk is full or gone.
        """
        if len(data) > MAX_READ_BYTES:
            raise ValueError(f"a read of {len(data)} bytes: a record holds at most {MAX_READ_BYTES}")
        record = _HEAD.pack(arrival_s, len(data)) + data
        self._append(record + _CRC.pack(binascii.crc_hqx(record, 0xFFFF)))

    def sync(self) -> None:
        """Wait until all data are on disk, which is necessary only against a power failure."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Have the disk take all, and close."""
        if self._descriptor >= 0:
            try:
                self.sync()
            finally:
                os.close(self._descriptor)
                self._descriptor = -1

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _append(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self._descriptor, view) :]


def is_capture(path: Path) -> bool:
    """Return True if a file begins as a raw capture does."""
    try:
        with _open(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except (OSError, EOFError, zlib.error):
        return False


def read_header(path: Path) -> CaptureHeader:
    """Header of a capture.

    Raises:
        UserError: No capture, or one of a later version.
    """
    try:
        with _open(path) as file:
            return _read_header(path, file)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def read_capture(path: Path) -> Iterator[CaptureBatch]:
    """Batches of reads, each about ``CHUNK_BYTES`` of file, to the last whole record.

    Iterating a batch gives the calls that the live decoder got; ``decoder.feed_reads(batch.arrivals_s, batch.ends,
    batch.data)`` makes the same samples faster.

    Raises:
        UserError: No capture, or one of a later version.
    """
    try:
        file = _open(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    with file:
        try:
            _read_header(path, file)
        except (OSError, EOFError, zlib.error) as error:
            raise UserError(f"{path}: cannot be read: {error}") from None
        rest = b""
        while more := _read_some(file, CHUNK_BYTES):
            raw = np.frombuffer(rest + more, dtype=np.uint8)
            batch, taken = _split(raw)
            rest = raw[taken:].tobytes()
            if batch.ends.size or batch.damaged:
                yield batch
            if batch.damaged:
                return
        if rest:
            yield dataclasses.replace(_split(np.frombuffer(b"", dtype=np.uint8))[0], unread_bytes=len(rest))


def _split(raw: NDArray[np.uint8]) -> tuple[CaptureBatch, int]:
    """Whole records of ``raw``, and how many bytes they took."""
    most = raw.size // RECORD_OVERHEAD_BYTES + 1
    arrival_bits, ends = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    payload = np.empty(raw.size, dtype=np.uint8)
    taken, records, filled, damaged = split_records(raw, MAX_READ_BYTES, arrival_bits, ends, payload)
    payload.setflags(write=False)  # as bytes from the line are: the decoder is compiled for one of both
    arrivals_s = arrival_bits[:records].view(np.float64)
    return CaptureBatch(arrivals_s, ends[:records], payload[:filled], bool(damaged)), taken


def _open(path: Path) -> IO[bytes]:
    if path.suffix == ".gz":
        return cast("IO[bytes]", gzip.open(path))
    return path.open("rb")


def _read_some(file: IO[bytes], size: int) -> bytes:
    """Up to ``size`` bytes; a gzip file that was cut off or is damaged ends where it is."""
    try:
        return file.read(size)
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return b""


def _read_header(path: Path, file: IO[bytes]) -> CaptureHeader:
    head = file.read(len(MAGIC) + _LENGTH.size)
    if not head.startswith(MAGIC):
        raise UserError(f"{path}: no raw capture: it does not begin with {MAGIC!r}")
    if len(head) < len(MAGIC) + _LENGTH.size:
        raise UserError(f"{path}: cut off within its header")
    (length,) = _LENGTH.unpack(head[len(MAGIC) :])
    text, crc = file.read(min(length, _MAX_HEADER_BYTES)), file.read(_CRC.size)
    if len(text) != length or len(crc) != _CRC.size or _CRC.unpack(crc)[0] != binascii.crc_hqx(text, 0xFFFF):
        raise UserError(f"{path}: its header is damaged or cut off")
    return _checked_header(path, text)


def _checked_header(path: Path, text: bytes) -> CaptureHeader:
    """Parse and check a header's JSON.

    Raises:
        UserError: It is not a header, or one of a later version; the message names the file and the error.
    """
    try:
        found = _VERSIONED.validate_json(text)
        if found.version != VERSION:
            raise UserError(f"{path}: version {found.version}, this program reads version {VERSION}")
        return _HEADER.validate_json(text)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        where = "".join(f"{key}: " for key in wrong["loc"])
        raise UserError(f"{path}: its header is none of this program's: {where}{wrong['msg'].lower()}") from None
