"""Folder of a backup: snapshots of streams, copies of further files, and ``backup.json``, which lists them with their digests.

``backup.json`` is written last, so that a folder without it is an incomplete backup. All files are readable by their owner only.
"""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from bms_estimator.fleet.nats.stream_snapshot import StreamInfo
from bms_estimator.model.errors import UserError
from bms_estimator.process.state_folder import UnsafeFileError, read_private, write_private

LIST_FILE = "backup.json"
"""Name of the file that lists all others."""
MAX_FILE_BYTES = 64 << 20
"""Maximum size of a copied file, and of ``backup.json`` [bytes]."""
CHUNK_BYTES = 128 << 10
"""Size of the chunks in which snapshots are read [bytes]."""


class FileDigest(BaseModel):
    """Size and digest of a file."""

    model_config = ConfigDict(frozen=True)

    bytes: int
    sha256: str


class BackupList(BaseModel):
    """Content of ``backup.json``."""

    model_config = ConfigDict(frozen=True)

    version: Literal[1] = 1
    made: str
    """Start time of the backup (RFC 3339)."""
    program: str
    """Version of the program that made the backup."""
    partitions: int
    streams: dict[str, StreamInfo]
    files: dict[str, FileDigest]
    """Digests by path within the folder."""


class FileWriter:
    """Writer of a private file, which computes its digest."""

    def __init__(self, path: Path) -> None:
        self._file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
        self._sha256, self._bytes = hashlib.sha256(), 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, data: bytes) -> None:
        """Append bytes."""
        self._file.write(data)
        self._sha256.update(data)
        self._bytes += len(data)

    def sync(self) -> FileDigest:
        """Sync the file to disk, and return its digest."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return FileDigest(bytes=self._bytes, sha256=self._sha256.hexdigest())


def snapshot_path(stream: str) -> str:
    """Return the path of a stream's snapshot within the folder."""
    return f"streams/{stream}"


def make_folder(folder: Path) -> None:
    """Create the folder of a new backup.

    Raises:
        UserError: The folder is not empty, or cannot be created.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UserError(f"{folder}: is not empty: choose a new folder for each backup")
        (folder / "streams").mkdir(mode=0o700)
    except OSError as error:
        raise UserError(f"{folder}: cannot be created: {error.strerror}") from None


def copy_files(paths: list[Path], folder: Path) -> dict[str, FileDigest]:
    """Copy files and folders into the subfolder ``files`` of a backup, and return their digests.

    Raises:
        UserError: A file cannot be read, or two files have the same name.
    """
    digests = dict[str, FileDigest]()
    for path in paths:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_dir():
                continue
            copy = folder / "files" / path.absolute().name / file.relative_to(path)
            if copy.exists():
                raise UserError(f"{file}: the backup already has a file of this name")
            digests[str(copy.relative_to(folder))] = _copy(file, copy)
    return digests


def _copy(file: Path, copy: Path) -> FileDigest:
    try:
        content = read_private(file, MAX_FILE_BYTES)
        for parent in reversed(copy.parents):  # with ``parents=True`` the mode would apply to the last folder only
            parent.mkdir(mode=0o700, exist_ok=True)
        write_private(copy, content)
    except UnsafeFileError as error:
        raise UserError(f"{file}: {error}") from None
    except OSError as error:
        raise UserError(f"{file}: cannot be copied: {error.strerror}") from None
    return FileDigest(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())


def write_list(folder: Path, backup: BackupList) -> None:
    """Write ``backup.json``, which completes the backup."""
    write_private(folder / LIST_FILE, backup.model_dump_json(indent=1).encode())


def read_list(folder: Path) -> BackupList:
    """Read ``backup.json``, and check the digests of all files.

    Raises:
        UserError: The backup is incomplete, damaged, or of another version.
    """
    try:
        backup = BackupList.model_validate_json(read_private(folder / LIST_FILE, MAX_FILE_BYTES))
    except FileNotFoundError:
        raise UserError(f"{folder}: no complete backup, because {LIST_FILE} is missing") from None
    except (OSError, UnsafeFileError) as error:
        raise UserError(f"{folder / LIST_FILE}: cannot be read: {error}") from None
    except ValidationError as error:
        detail = error.errors()[0]
        raise UserError(f"{folder / LIST_FILE}: {'.'.join(map(str, detail['loc']))}: {detail['msg']}") from None
    for name, digest in backup.files.items():
        _check_file(folder / name, digest)
    return backup


def _check_file(path: Path, digest: FileDigest) -> None:
    sha256, size = hashlib.sha256(), 0
    try:
        for chunk in read_chunks(path):
            sha256.update(chunk)
            size += len(chunk)
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}: the backup is incomplete") from None
    if size != digest.bytes:
        raise UserError(f"{path}: has {size} bytes instead of {digest.bytes}: the backup is damaged")
    if sha256.hexdigest() != digest.sha256:
        raise UserError(f"{path}: does not match its digest: the backup is damaged")


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file."""
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
