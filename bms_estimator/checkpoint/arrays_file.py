"""Files of arrays beside the checkpoint of the same pack: the history with its last fit, and the observed load."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import pack_identity
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.process.private_file import UnsafeFileError, read_private, write_private
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
        self._is_later = False
        self.path = folder / f"{self._name}-{self._identity[:8]}{suffix}"

    def save(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write the file atomically.

        Raises:
            OSError: The file cannot be written.
        """
        packed = io.BytesIO()
        content: dict[str, Any] = {"format": FORMAT, "identity": self._identity, **arrays}
        np.savez_compressed(packed, **content)
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(self.path, packed.getbuffer())

    def load(self) -> dict[str, NDArray[Any]]:
        """Return the saved arrays; an empty dictionary without a file.

        Raises:
            RejectedFileError: The file is damaged, has another format, or belongs to another pack.
        """
        self._is_later = False
        try:
            with np.load(io.BytesIO(read_private(self.path, MAX_FILE_BYTES)), allow_pickle=False) as file:
                arrays = dict(file)
            version, identity = int(arrays.pop("format")), str(arrays.pop("identity"))
        except FileNotFoundError:
            return {}
        except UnsafeFileError as error:
            raise RejectedFileError(str(error)) from error
        except Exception as error:  # a damaged file may raise anything, and is reported
            raise RejectedFileError(f"damaged, perhaps by a power cut ({type(error).__name__})") from error
        self._is_later = version > FORMAT
        if version != FORMAT:
            raise RejectedFileError(f"format {version}, this version reads {FORMAT}")
        if identity != self._identity:
            raise RejectedFileError("it belongs to another pack or cell")
        return arrays

    def quarantine(self) -> str:
        """Rename a rejected file, so that the next save does not overwrite it. Return a description for the user."""
        kept = self.path.with_name(f"{self._name}.{'later' if self._is_later else 'refused'}{self._suffix}")
        try:
            self.path.replace(kept)
        except OSError as error:
            return f"it cannot be set aside: {error}"
        return f"set aside as {kept.name}"
