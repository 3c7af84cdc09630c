r"""Raw captures: the bytes that a decoder was fed, with their arrival times.

File format, version 1, numbers little-endian::

    header   8 bytes  "BMSRAW1\n"
             u32      length of the JSON that follows
             JSON     UTF-8: version, started (wall clock, ISO 8601 UTC), mode ("binary", "text" or another protocol),
                      port, baud, current_sign, address, voltage_gain, current_gain,
                      current_zero_a; other names are ignored
             u16      CRC-16/CCITT-FALSE of the JSON
    record   f64      arrival time [s], bit-identical to the decoder's input
             u32      length
             bytes
             u16      CRC-16/CCITT-FALSE of the record up to here

After the header, each read of the line is one record. The file is only appended to, with one system call for each record.
After a crash of the recorder all complete records are valid, and an incomplete last one is ignored. A file may be
compressed with gzip.
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
from bms_estimator.protocols.registry import valid_addresses
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.settings.sources.source import BaseSource
from bms_estimator.sources.captures.capture_records import RECORD_OVERHEAD_BYTES, split_records
from bms_estimator.sources.captures.tables.text_file import GZIP_MAGIC

MAGIC = b"BMSRAW1\n"
"""First bytes of a raw capture."""
VERSION = 1
MAX_READ_BYTES = 1 << 20
"""Maximum length of the bytes in a record."""
CHUNK_BYTES = 1 << 20
"""Size of the parts in which a capture is read [bytes]."""
_RECORD_HEAD = struct.Struct("<dI")
_LENGTH = struct.Struct("<I")
_CRC = struct.Struct("<H")
_MAX_HEADER_BYTES = 1 << 20
"""Maximum length of the JSON in the header [bytes]."""


@dataclass(config=ConfigDict(strict=True, extra="ignore", frozen=True))
class _HeaderVersion:
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
    """Wall clock at the start of the recording, ISO 8601 UTC; empty: set by the writer."""
    version: int = VERSION
    address: int | None = None
    """Address of the recorded pack, if the line had several."""
    batteries: int | None = None
    """Number of batteries in parallel, if the protocol sums their values."""
    voltage_gain: float = 1.0
    current_gain: float = 1.0
    current_zero_a: float = 0.0


CORRECTIONS = ("voltage_gain", "current_gain", "current_zero_a")
"""Fields of a header that correct the measured values, as in ``[sensor]``."""
_VERSION_ADAPTER, _HEADER_ADAPTER = TypeAdapter(_HeaderVersion), TypeAdapter(CaptureHeader)


def make_header(sensor: SensorSettings, source: BaseSource | None = None) -> CaptureHeader:
    """Return the header of a capture of ``source``; without a source, of the serial device of ``sensor``."""
    if source is not None:
        device = CaptureHeader(sensor.protocol, source.short_description)
    else:
        device = CaptureHeader(
            sensor.protocol, sensor.port, sensor.baud, address=sensor.address, batteries=sensor.batteries
        )
    decoder_settings = {name: getattr(sensor, name) for name in ("current_sign", *CORRECTIONS)}
    return dataclasses.replace(device, **decoder_settings)


def read_sensor_settings(path: Path) -> SensorSettings:
    """Return the board settings of the capture ``path`` that decoding needs.

    Raises:
        UserError: The header cannot be read, or its protocol is unknown.
    """
    header = read_header(path)
    try:
        # earlier versions accepted an address for each protocol
        address = header.address if header.address in valid_addresses(header.mode) else None
        device = {"protocol": header.mode, "address": address, "batteries": header.batteries}
        fields = device | {"current_sign": header.current_sign}
        corrections = {name: getattr(header, name) for name in CORRECTIONS}
        return SensorSettings.model_validate(fields | corrections)
    except ValidationError:
        raise UserError(
            f"{path}: recorded with mode {header.mode!r} and current_sign {header.current_sign!r}: "
            "this program does not support at least one of them"
        ) from None


@dataclasses.dataclass(frozen=True)
class CaptureBatch:
    """Batch of recorded reads, as arguments of a decoder's ``feed_reads``."""

    arrivals_s: NDArray[np.float64]
    """Arrival time of each read [s]."""
    ends: NDArray[np.int64]
    """End of each read's bytes in ``data``."""
    data: NDArray[np.uint8]
    """Concatenated bytes of the reads."""
    damaged: bool
    """True if the record after this batch is damaged."""
    unread_bytes: int = 0
    """Number of bytes of an incomplete record at the end of the file."""

    def __iter__(self) -> Iterator[tuple[float, bytes]]:
        """Yield arrival time [s] and bytes of each read."""
        begin = 0
        for arrival_s, end in zip(self.arrivals_s.tolist(), self.ends.tolist(), strict=True):
            yield arrival_s, self.data[begin:end].tobytes()
            begin = end


class CaptureWriter:
    """Writer of a capture; a context manager.

    Args:
        path: A file that does not exist yet.
        header: Header of the capture.

    Raises:
        UserError: The file exists or cannot be created.
    """

    def __init__(self, path: Path, header: CaptureHeader) -> None:
        started = header.started or datetime.now(tz=UTC).isoformat(timespec="milliseconds")
        header_json = json.dumps(dataclasses.asdict(header) | {"started": started}).encode()
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except FileExistsError:
            raise UserError(f"{path}: exists already; a capture is never overwritten") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None
        crc = _CRC.pack(binascii.crc_hqx(header_json, 0xFFFF))
        self._append(MAGIC + _LENGTH.pack(len(header_json)) + header_json + crc)

    def write(self, arrival_s: float, data: bytes) -> None:
        """Append one read of the line.

        Args:
            arrival_s: Arrival time, bit-identical to the decoder's input [s].
            data: The bytes, at most ``MAX_READ_BYTES``.

        Raises:
            ValueError: ``data`` is longer than ``MAX_READ_BYTES``.
            OSError: The disk is full or was removed.
        """
        if len(data) > MAX_READ_BYTES:
            raise ValueError(f"a read of {len(data)} bytes: a record holds at most {MAX_READ_BYTES}")
        record = _RECORD_HEAD.pack(arrival_s, len(data)) + data
        self._append(record + _CRC.pack(binascii.crc_hqx(record, 0xFFFF)))

    def sync(self) -> None:
        """Wait until all data are on disk, as a protection against power failures."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Sync to disk, and close the file."""
        if self._descriptor >= 0:
            try:
                self.sync()
            finally:
                os.close(self._descriptor)
                self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _append(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self._descriptor, view) :]


def is_capture(path: Path) -> bool:
    """Return True if a file begins with the magic bytes of a raw capture."""
    try:
        with _open(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except (OSError, EOFError, zlib.error):
        return False


def read_header(path: Path) -> CaptureHeader:
    """Read the header of a capture.

    Raises:
        UserError: The file is not a raw capture, or has a later version.
    """
    try:
        with _open(path) as file:
            return _read_header(path, file)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def read_capture(path: Path) -> Iterator[CaptureBatch]:
    """Yield batches of about ``CHUNK_BYTES`` of the file, up to the last complete record.

    The items of a batch are the arguments of the recorded calls of ``feed``. One call of ``decoder.feed_reads`` with the
    arrays of the batch decodes the same samples faster.

    Raises:
        UserError: The file is not a raw capture, or has a later version.
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
        unparsed = b""  # start of an incomplete record
        while chunk := _read_chunk(file, CHUNK_BYTES):
            raw = np.frombuffer(unparsed + chunk, dtype=np.uint8)
            batch, parsed_bytes = _split(raw)
            unparsed = raw[parsed_bytes:].tobytes()
            if batch.ends.size or batch.damaged:
                yield batch
            if batch.damaged:
                return
        if unparsed:  # the record is known to be incomplete only at the end of the file, after the last batch
            empty_batch, _ = _split(np.frombuffer(b"", dtype=np.uint8))
            yield dataclasses.replace(empty_batch, unread_bytes=len(unparsed))


def _split(raw: NDArray[np.uint8]) -> tuple[CaptureBatch, int]:
    """Return the complete records of ``raw``, and their length in ``raw`` [bytes]."""
    max_records = raw.size // RECORD_OVERHEAD_BYTES + 1
    arrival_bits, ends = np.empty(max_records, dtype=np.int64), np.empty(max_records, dtype=np.int64)
    payload = np.empty(raw.size, dtype=np.uint8)
    parsed_bytes, records, payload_bytes, damaged = split_records(raw, MAX_READ_BYTES, arrival_bits, ends, payload)
    payload.setflags(write=False)  # the decoder is compiled for the read-only arrays of live bytes
    arrivals_s = arrival_bits[:records].view(np.float64)
    return CaptureBatch(arrivals_s, ends[:records], payload[:payload_bytes], bool(damaged)), parsed_bytes


def _open(path: Path) -> IO[bytes]:
    file = path.open("rb")
    is_gzip = file.read(len(GZIP_MAGIC)) == GZIP_MAGIC
    file.seek(0)
    if not is_gzip:
        return file
    file.close()
    return cast("IO[bytes]", gzip.open(path))


def _read_chunk(file: IO[bytes], size: int) -> bytes:
    """Read up to ``size`` bytes. A truncated or damaged gzip file counts as ended."""
    try:
        return file.read(size)
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return b""


def _read_header(path: Path, file: IO[bytes]) -> CaptureHeader:
    head = file.read(len(MAGIC) + _LENGTH.size)
    if not head.startswith(MAGIC):
        raise UserError(f"{path}: not a raw capture: it does not begin with {MAGIC!r}")
    if len(head) < len(MAGIC) + _LENGTH.size:
        raise UserError(f"{path}: cut off within its header")
    (length,) = _LENGTH.unpack(head[len(MAGIC) :])
    text, crc = file.read(min(length, _MAX_HEADER_BYTES)), file.read(_CRC.size)
    if len(text) != length or len(crc) != _CRC.size or _CRC.unpack(crc)[0] != binascii.crc_hqx(text, 0xFFFF):
        raise UserError(f"{path}: its header is damaged or cut off")
    return _parse_header(path, text)


def _parse_header(path: Path, text: bytes) -> CaptureHeader:
    """Parse and check a header's JSON.

    Raises:
        UserError: The JSON is not a valid header, or has a later version; the message names the file and the error.
    """
    try:
        header = _VERSION_ADAPTER.validate_json(text)
        if header.version != VERSION:
            raise UserError(f"{path}: version {header.version}, this program reads version {VERSION}")
        return _HEADER_ADAPTER.validate_json(text)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        field_path = "".join(f"{key}: " for key in detail["loc"])
        raise UserError(f"{path}: its header is not valid: {field_path}{detail['msg'].lower()}") from None
