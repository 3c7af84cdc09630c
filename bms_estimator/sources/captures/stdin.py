"""Capture from a pipe, copied to a file because readers need a file's size and read it twice."""

import gzip
import shutil
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.raw_capture import MAGIC

DISPLAY_NAME = "stdin"
"""Name used in messages."""
GZIP_MAGIC, PARQUET_MAGIC = b"\x1f\x8b", b"PAR1"
"""First bytes of gzip and Parquet files."""


@contextmanager
def standard_input() -> Iterator[Path]:
    """Copy stdin to a temporary file with the suffix of its format; yield its path, and delete it on exit.

    Raises:
        UserError: Stdin is closed. An error raised inside the context shows ``stdin`` instead of the temporary path.
    """
    if not sys.stdin:
        raise UserError(f"{DISPLAY_NAME}: closed; nothing can be read from it")
    with TemporaryDirectory() as folder:
        plain = Path(folder) / DISPLAY_NAME
        with plain.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        path = plain.rename(plain.with_name(DISPLAY_NAME + _suffix(plain)))
        try:
            yield path
        except UserError as error:
            raise UserError(str(error).replace(str(path), DISPLAY_NAME)) from None


def _suffix(path: Path) -> str:
    """Return the file name extension that selects the reader of ``path``."""
    with path.open("rb") as file:
        first = file.read(len(MAGIC))
    if first.startswith(PARQUET_MAGIC):
        return ".parquet"
    if not first.startswith(GZIP_MAGIC):
        return "" if first == MAGIC else ".csv"
    try:
        with gzip.open(path) as packed:
            return ".gz" if packed.read(len(MAGIC)) == MAGIC else ".csv.gz"
    except (OSError, EOFError, zlib.error):
        return ".csv.gz"  # the reader of such files reports the error
