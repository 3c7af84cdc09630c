"""Capture from a pipe, copied to a file because readers need a file's size and read it twice."""

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from bms_estimator.model.errors import UserError

DISPLAY_NAME = "stdin"
"""Name used in messages."""


@contextmanager
def standard_input() -> Iterator[Path]:
    """Copy stdin to a temporary file; yield its path, and delete it on exit.

    Raises:
        UserError: Stdin is closed. An error raised inside the context shows ``stdin`` instead of the temporary path.
    """
    if not sys.stdin:
        raise UserError(f"{DISPLAY_NAME}: closed; nothing can be read from it")
    with TemporaryDirectory() as folder:
        path = Path(folder) / DISPLAY_NAME
        with path.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        try:
            yield path
        except UserError as error:
            raise UserError(str(error).replace(str(path), DISPLAY_NAME)) from None
