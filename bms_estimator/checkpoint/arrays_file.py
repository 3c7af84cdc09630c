"""Files of a pack's arrays, saved beside its checkpoint: the history with its last fit, and the observed load."""

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import pack_identity
from bms_estimator.model.pack_model import PackModel
from bms_estimator.process.state_folder import UnsafeFileError, read_private, write_private
from bms_estimator.settings.pack import Settings

FORMAT = 1
"""Version of the file's layout. Increment it when a field changes its meaning."""
MAX_FILE_BYTES = 4 << 20
"""Maximum size of a file [bytes]. A full history of 5000 rows has about 1 MB before compression."""
HISTORY_SUFFIX = ".history.npz"
"""End of the name of the file with the history."""
LOAD_SUFFIX = ".load.npz"
"""End of the name of the file with the load."""


class RejectedFileError(Exception):
    """A file cannot be used. The message gives the reason."""


@contextlib.contextmanager
def reject_damaged() -> Iterator[None]:
    """Convert any exception of a damaged file to a ``RejectedFileError``. A missing file raises a ``FileNotFoundError``."""
    try:
        yield
    except (FileNotFoundError, RejectedFileError):
        raise
    except UnsafeFileError as error:
        raise RejectedFileError(str(error)) from error
    except Exception as error:  # a damaged file may raise anything, and is reported
        raise RejectedFileError(f"damaged, perhaps by a power cut ({type(error).__name__})") from error


def read_arrays(path: Path, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file of at most ``max_bytes``. A damaged file may raise any exception."""
    with np.load(io.BytesIO(read_private(path, max_bytes)), allow_pickle=False) as file:
        return dict(file)


def to_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Return the bytes of a compressed ``.npz`` file with arrays and scalars by name."""
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return packed.getvalue()


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays atomically to a file.

    Raises:
        OSError: The file cannot be written.
    """
    write_private(path, to_bytes(arrays))


def set_aside(path: Path, target: Path) -> str:
    """Rename a rejected file, so that the next save does not overwrite it. Return a description for the user."""
    try:
        path.replace(target)
    except OSError as error:
        return f"it cannot be set aside: {error}"
    return f"set aside as {target.name}"


class ArraysFile:
    """File of arrays of one pack, ``<pack.name>-<identity><suffix>``.

    Args:
        folder: Folder of the file.
        settings: The pack's settings.
        cell: Model of battery or fuel cell, with the values of the whole pack.
        suffix: End of the file's name.
    """

    def __init__(self, folder: Path, settings: Settings, cell: PackModel, suffix: str) -> None:
        self._suffix = suffix
        self._name, self._identity = settings.pack.name, pack_identity(settings, cell)
        self._is_later = (
            False  # the file has a later format; it gets another name, because the later version can read it
        )
        self.path = folder / f"{self._name}-{self._identity[:8]}{suffix}"

    def save(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write the file atomically.

        Raises:
            OSError: The file cannot be written.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_arrays(self.path, {"format": FORMAT, "identity": self._identity, **arrays})

    def load(self) -> dict[str, NDArray[Any]]:
        """Return the saved arrays; an empty dictionary without a file.

        Raises:
            RejectedFileError: The file is damaged, has another format, or belongs to another pack.
        """
        self._is_later = False
        try:
            with reject_damaged():
                arrays = read_arrays(self.path, MAX_FILE_BYTES)
                version, identity = int(arrays.pop("format")), str(arrays.pop("identity"))
        except FileNotFoundError:
            return {}
        self._is_later = version > FORMAT
        if version != FORMAT:
            raise RejectedFileError(f"format {version}, this version reads {FORMAT}")
        if identity != self._identity:
            raise RejectedFileError("it belongs to another pack or cell")
        return arrays

    def quarantine(self) -> str:
        """Rename a rejected file, so that the next save does not overwrite it. Return a description for the user."""
        return set_aside(
            self.path, self.path.with_name(f"{self._name}.{'later' if self._is_later else 'refused'}{self._suffix}")
        )
