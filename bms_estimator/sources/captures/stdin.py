"""Capture from a pipe as a file: readers measure a file's size and read it twice."""

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

NAME = "stdin"
"""Name used in messages."""
GZIP, PARQUET = b"\x1f\x8b", b"PAR1"
"""First bytes of such files."""


@contextmanager
def standard_input() -> Iterator[Path]:
    """All of stdin as a file, with the suffix of its format; closed on exit.

    Raises:
        UserError: It is closed; or as raised while it is used, its folder left out of the message.
    """
    if not sys.stdin:
        raise UserError(f"{NAME}: closed; nothing can be read from it")
    with TemporaryDirectory() as folder:
        plain = Path(folder) / NAME
        with plain.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        path = plain.rename(plain.with_name(NAME + _ending(plain)))
        try:
            yield path
        except UserError as error:
            raise UserError(str(error).replace(str(path), NAME)) from None


def _ending(path: Path) -> str:
    """Return the file name extension that selects the reader of ``path``."""
    with path.open("rb") as file:
        first = file.read(len(MAGIC))
    if first.startswith(PARQUET):
        return ".parquet"
    if not first.startswith(GZIP):
        return "" if first == MAGIC else ".csv"
    try:
        with gzip.open(path) as packed:
            return ".gz" if packed.read(len(MAGIC)) == MAGIC else ".csv.gz"
    except (OSError, EOFError, zlib.error):
        return ".csv.gz"  # whose reader reports errors
