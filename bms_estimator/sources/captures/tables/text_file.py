"""Text of a file: plain, gzipped or the only member of a zip archive, in UTF-8, UTF-16, GB 18030 or latin-1."""

import codecs
import gzip
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import IO, cast

from bms_estimator.model.errors import UserError

GZIP_MAGIC, ZIP_MAGIC = b"\x1f\x8b", b"PK\x03\x04"
"""First bytes of gzip files and of zip archives."""
SAMPLE_BYTES = 65_536
"""Number of bytes that show the encoding."""
MAX_UTF_8_BYTES = 4
"""Maximum length of a character in UTF-8. The end of the sample may be within a character."""
_HIGH_BYTES, _GB_2312 = re.compile(rb"[\x80-\xff]+"), re.compile(rb"(?:[\xa1-\xf7][\xa1-\xfe])+")
_HANZI = re.compile(rb"(?:..)*?[\xb0-\xf7][\xa1-\xfe]", re.DOTALL)
_LATIN_1_BYTES = "latin-1-bytes"
"""Error handler of the UTF-8 decoder that reads invalid bytes as latin-1."""


def _decode_latin_1(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError):
        raise error
    return error.object[error.start : error.end].decode("latin-1"), error.end


codecs.register_error(_LATIN_1_BYTES, _decode_latin_1)


class TextFile:
    """Text file that may be compressed.

    Args:
        path: The file. Compression and encoding are recognized by its first bytes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._raw: IO[bytes] | None = None
        self._size = 0

    @property
    def fraction(self) -> float:
        """Fraction of the file that has been read, 0..1."""
        if self._raw is None:
            return 0.0
        return 1.0 if self._raw.closed else self._raw.tell() / max(self._size, 1)

    @contextmanager
    def open(self) -> Iterator[TextIOWrapper]:
        """Open the text.

        Raises:
            UserError: The file cannot be read, or an archive does not have exactly one member.
        """
        try:
            with self.path.open("rb") as self._raw:
                self._size = self.path.stat().st_size
                with self._decompress(self._raw) as plain:
                    yield _decode(plain)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise UserError(f"{self.path}: gzip data damaged or cut short: {error}") from None
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
            raise UserError(f"{self.path}: zip archive damaged, encrypted or of an unknown kind: {error}") from None
        except UnicodeDecodeError:
            raise UserError(f"{self.path}: not a text file") from None
        except OSError as error:
            raise UserError(f"{self.path}: cannot be read: {error.strerror or error}") from None

    @contextmanager
    def _decompress(self, raw: IO[bytes]) -> Iterator[IO[bytes]]:
        magic = raw.read(len(ZIP_MAGIC))
        raw.seek(0)
        if magic.startswith(GZIP_MAGIC):
            yield cast("IO[bytes]", gzip.GzipFile(fileobj=raw))
        elif magic == ZIP_MAGIC:
            with zipfile.ZipFile(raw) as archive, archive.open(self._only_member(archive)) as member:
                yield member
        else:
            yield raw

    def _only_member(self, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
        """Return the only file of an archive; folders and the metadata of macOS are ignored."""
        members = [
            info
            for info in archive.infolist()
            if not info.filename.endswith("/") and not info.filename.startswith("__MACOSX/")
        ]
        if len(members) != 1:
            names = ", ".join(info.filename for info in members) or "none"
            raise UserError(f"{self.path}: the archive must contain one file, but has {len(members)}: {names}")
        return members[0]


def _decode(plain: IO[bytes]) -> TextIOWrapper:
    """Return a byte stream as text. The encoding is recognized by its byte order mark, zero bytes of UTF-16, or Chinese pairs."""
    sample = plain.read(SAMPLE_BYTES)
    plain.seek(0)
    head = sample[:2]
    if head in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return TextIOWrapper(plain, encoding="utf-16")
    if len(head) == 2 and 0 in head:
        return TextIOWrapper(plain, encoding="utf-16-le" if head[1] == 0 else "utf-16-be")
    if _is_chinese(sample):
        return TextIOWrapper(plain, encoding="gb18030", errors="replace")
    return TextIOWrapper(plain, encoding="utf-8-sig", errors=_LATIN_1_BYTES)


def _is_chinese(sample: bytes) -> bool:
    """Return True if all bytes beyond ASCII are pairs of the Chinese encoding GB 2312, and they are not UTF-8.

    In latin-1 a letter or sign beyond ASCII rarely follows another one.
    """
    try:
        sample[:-MAX_UTF_8_BYTES].decode()
    except UnicodeDecodeError:
        runs = _HIGH_BYTES.findall(sample[: sample.rfind(b"\n") + 1])
        return any(map(_HANZI.match, runs)) and all(map(_GB_2312.fullmatch, runs))
    return False
