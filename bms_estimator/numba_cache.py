"""Compile kernels with a disk cache that notices every changed source file.

numba checks only the file of the compiled function. It does not notice a change in the files of the functions that the
kernel calls, or of the constants that it compiles in. Therefore the cache folder carries a hash of all these files.

Every kernel imports ``njit`` from here: importing it sets the cache folder. If the cache cannot be written or read,
kernels are compiled at each start. Each cached file ends with a digest, because machine code damaged by a power cut
would run.
"""

import contextlib
import hashlib
import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
from numba import njit
from numba.core.caching import Cache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

__all__ = ["COMPILED_IN", "njit"]

DIGEST_BYTES = 32
# Any, because methods of these classes are replaced below
_Cache: Any = Cache
_CacheFile: Any = IndexDataCacheFile
_Dispatcher: Any = Dispatcher
_numba_dump, _numba_load = _CacheFile._dump, _CacheFile._load_data  # noqa: SLF001 - numba has no public hook for a check
_PACKAGE = Path(__file__).parent
COMPILED_IN = (
    *sorted((_PACKAGE / "kernels").rglob("*.py")),
    *(
        _PACKAGE / file
        for file in (
            "model/arrays.py",
            "model/sample.py",
            "model/input_faults.py",
            "protocols/base/relay.py",
            "protocols/firmware/clock_drift.py",
            "protocols/firmware/framing.py",
            "protocols/firmware/messages.py",
            "protocols/firmware/scaling.py",
            "sources/captures/capture_records.py",
        )
    ),
)
"""Files whose content is compiled into kernels: kernels, frame decoding and their constants."""


def _cache_folder() -> Path | None:
    """Return the folder of compiled kernels: NUMBA_CACHE_DIR, systemd's CacheDirectory, or the user's cache.

    Return None if none of these folders can be written.
    """
    digest = hashlib.sha256()
    for source in COMPILED_IN:
        digest.update(source.read_bytes())
    home_cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    candidates = [
        os.environ.get("NUMBA_CACHE_DIR"),
        os.environ.get("CACHE_DIRECTORY"),
        f"{home_cache}/bms_estimator",
    ]
    for candidate in candidates:
        if candidate:
            with contextlib.suppress(OSError, RuntimeError):  # RuntimeError: the user has no home folder
                folder = Path(candidate).expanduser() / digest.hexdigest()[:16]
                folder.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    return None


@contextlib.contextmanager
def _warn_on_cache_error(cache: Any) -> Iterator[None]:
    """Turn errors of the cache into warnings: numba then compiles the kernel instead of loading it."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"compiled kernels are not kept: {error.strerror}", RuntimeWarning, stacklevel=1)
    except Exception as error:  # noqa: BLE001 - a damaged file may raise anything
        warnings.warn(f"a compiled kernel cannot be read: {error!r}", RuntimeWarning, stacklevel=1)
        with contextlib.suppress(OSError):
            cache.flush()  # empties the index, so that the damaged file is not read again


def _dump_with_digest(file: Any, kernel: Any) -> bytes:
    """Serialize a kernel, or the index of a function's kernels, and append a digest."""
    content: bytes = _numba_dump(file, kernel)
    return content + hashlib.sha256(content).digest()


def _load_verified(file: Any, name: str) -> Any:
    """Read a cached kernel and verify its digest. The index contains no machine code and is not verified.

    Raises:
        ValueError: The file was changed after it was written.
    """
    stored = Path(file._data_path(name)).read_bytes()  # noqa: SLF001 - as in numba's own method
    content, digest = stored[:-DIGEST_BYTES], stored[-DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError(f"{name} is damaged")
    return _numba_load(file, name)  # unpickling ignores the digest after the pickle


def _enable_disk_cache(folder: Path | None) -> None:
    """Let numba store compiled kernels in ``folder``. Without a folder each process compiles them."""
    if folder is None:
        warnings.warn("compiled kernels are not kept: no folder can be written", RuntimeWarning, stacklevel=1)
        _Dispatcher.enable_caching = lambda _: None
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    # numba's context manager around each access to the cache; numba's own does nothing except on Windows
    _Cache._guard_against_spurious_io_errors = _warn_on_cache_error  # noqa: SLF001
    _CacheFile._dump, _CacheFile._load_data = _dump_with_digest, _load_verified  # noqa: SLF001


_enable_disk_cache(_cache_folder())
