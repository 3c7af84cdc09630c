"""Files of a pack's arrays, saved beside its checkpoint: the history with its last fit, and the observed load.

Hashes of settings and cell data identify the pack to which a file belongs.

Changes of the estimator's state since its checkpoint are in two files of one disk block each, which are written in turn.
Frequent saves thus wear an SD card little: overwriting a block changes neither the folder nor the file's length. A power
failure damages at most the block that is being written, and the other one has the state before it.
"""

import contextlib
import hashlib
import io
import json
import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from bms_estimator.checkpoint.run_file import CHECKSUM_BYTES, add_checksum, verify_checksum
from bms_estimator.model.arrays import fields
from bms_estimator.model.pack_model import PackModel
from bms_estimator.process.boot_timestamp import BootTimestamp
from bms_estimator.process.state_folder import UnsafeFileError, read_private, write_private
from bms_estimator.settings.pack import Settings


def pack_identity(settings: Settings, cell: PackModel) -> str:
    """Return the hash of all numbers on which the meaning of a state depends.

    For a battery, these are the number of cells in series, the capacity, the open-circuit voltage and the sign of the
    current. For a fuel cell, these are all parameters and the sign of the current. A changed description, tuning value
    or other setting does not change the hash.
    """
    return hashlib.sha256(repr(cell.state_basis(settings.sensor.current_sign)).encode()).hexdigest()


def observer_identity(settings: Settings, cell: PackModel) -> str:
    """Return the hash of all settings and cell data on which the observer's parameters and gain depend.

    With another hash the observer's own state is discarded; it converges again within seconds.
    """
    parts = (settings.observer, cell, settings.sensor.voltage_resolution_v)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def without_observer(state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the fields of a state that stay valid with another observer identity."""
    valid = "observer.soc", "observer.soc_coulomb", "observer.started"
    # ``learning`` and ``series_resistance`` are computed from the observer's estimates and are discarded with them
    prefixes = "observer.", "learning.", "series_resistance."
    return {name: v for name, v in state.items() if name in valid or not name.startswith(prefixes)}


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
    """Encode arrays and scalars by name."""
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
        self._is_later = False  # the file has a later format
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


CHANGES_SUFFIXES = ".changes-0", ".changes-1"
"""Suffixes of the two files."""
BLOCK_BYTES = 4096
"""Size of a file [bytes], a block of ext4. Changes of up to five hypotheses take 2 to 3.5 kB. If they do not fit, the whole
checkpoint is saved."""
MAX_BASE_AGE_S = 300.0
"""Maximum age of the checkpoint whose changes are saved [s]. A kill loses what the omitted fields have learned since then."""
MAX_SOC_CHANGE = 0.1
"""Maximum change of the SOC since the checkpoint. The covariances depend on the slope of the OCV at the SOC."""
MAX_STD_RATIO = 1.1
"""Maximum growth of the SOC's std since the checkpoint. A restart uses the checkpoint's covariance, which would be too small."""
ZLIB_LEVEL = 9
"""Compression level. Level 6 makes the file 1 % larger."""

log = structlog.get_logger(__name__)


class BaseCheckpoint(NamedTuple):
    """Saved checkpoint to which changes refer."""

    token: str
    """Random identifier of the checkpoint."""
    state: NDArray[np.void]
    """Shape (1,), dtype ESTIMATOR_STATE."""
    curves: Mapping[str, NDArray[Any]]
    """Arrays of the fit to whose curves the state is relative."""
    saved: BootTimestamp


class Changes(NamedTuple):
    """Changed fields of a state, and the time at which they were saved."""

    state: dict[str, NDArray[Any]]
    saved: BootTimestamp


class ChangesFile:
    """Files of the changes since one checkpoint.

    Args:
        checkpoint: Path of the checkpoint.
    """

    def __init__(self, checkpoint: Path) -> None:
        self._paths = [checkpoint.with_suffix(suffix) for suffix in CHANGES_SUFFIXES]
        self._base: BaseCheckpoint | None = None
        self._saves = 0

    def set_base(self, base: BaseCheckpoint) -> None:
        """Set the checkpoint to which the next changes refer. Its token makes the present files invalid."""
        self._base = base

    def save(self, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp) -> bool:
        """Write the changed fields of ``state``. Return False if the checkpoint must be saved instead.

        Args:
            state: Shape (1,), dtype ESTIMATOR_STATE.
            curves: Arrays of the fit to whose curves the state is relative.
            now: Present time.
        """
        if self._base is None or not _is_small_change(self._base, state, curves, now):
            return False
        changed = state.copy()
        for name, values in fields(changed):
            if _is_omitted(name):
                values[...] = 0  # compressed to a few bytes
        changed["filter"]["mean"][0, int(state["filter"]["count"][0]) :] = 0.0  # values of merged hypotheses
        self._saves += 1
        head = json.dumps({"token": self._base.token, "saves": self._saves, **asdict(now)}).encode()
        body = head + b"\n" + zlib.compress(changed.tobytes(), ZLIB_LEVEL)
        block = add_checksum(body.ljust(BLOCK_BYTES - CHECKSUM_BYTES, b"\0"))
        if len(block) > BLOCK_BYTES:
            return False
        try:
            _overwrite(self._paths[self._saves % 2], block)
        except OSError:
            return False  # the save of the checkpoint reports what is wrong with the disk
        return True

    def load(self, token: str, dtype: np.dtype[Any]) -> Changes | None:
        """Read the newest changes since a checkpoint; None if there are none. A damaged file is logged and ignored.

        Args:
            token: Identifier of the checkpoint.
            dtype: Dtype of the checkpoint's state.
        """
        newest, newest_saves = None, 0
        for path in self._paths:
            try:
                head, _, packed = verify_checksum(read_private(path, BLOCK_BYTES)).partition(b"\n")
                values = json.loads(head)
                saves = values.pop("saves")
                if values.pop("token") == token and saves > newest_saves:
                    state = np.frombuffer(bytearray(zlib.decompressobj().decompress(packed)), dtype)
                    changed = {name: value for name, value in fields(state) if not _is_omitted(name)}
                    newest, newest_saves = Changes(changed, BootTimestamp(**values)), saves
            except FileNotFoundError:
                continue
            except Exception as error:  # noqa: BLE001 - a damaged file may raise anything, and is reported
                log.warning("changes since the checkpoint are damaged and not used", file=str(path), reason=str(error))
        return newest


def _overwrite(path: Path, block: bytes) -> None:
    """Overwrite a file of one block in place, and sync it to disk.

    Raises:
        OSError: The file cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        write_private(path, block)
        return
    with open(descriptor, "wb", buffering=0) as file:  # noqa: PTH123 - a descriptor has no Path
        file.write(block)
        os.fdatasync(file.fileno())


def _is_small_change(
    base: BaseCheckpoint, state: NDArray[np.void], curves: Mapping[str, NDArray[Any]], now: BootTimestamp
) -> bool:
    """Return True if the omitted fields of a recent checkpoint are still valid with the other fields of ``state``."""
    if not 0.0 <= now.since(base.saved) < MAX_BASE_AGE_S:
        return False
    if curves.keys() != base.curves.keys() or not all(
        np.array_equal(curves[name], base.curves[name]) for name in curves
    ):
        return False
    saved, present = base.state[0]["filter"], state[0]["filter"]
    soc_change = abs(state[0]["observer"]["soc"] - base.state[0]["observer"]["soc"])
    has_same_hypotheses = present["seeded_s"] >= saved["seeded_s"] and all(
        saved[name] == present[name] for name in ("count", "started", "reopened", "exchanged")
    )
    has_grown = present["soc_std"] > MAX_STD_RATIO * saved["soc_std"]
    return has_same_hypotheses and not (has_grown or soc_change > MAX_SOC_CHANGE)  # NaN is no change


def _is_omitted(name: str) -> bool:
    """Return True for fields that are not saved, because they change slowly or are large."""
    return name == "filter.covariance" or name.startswith(("checks.good_", "map.", "series_resistance.", "fit."))
