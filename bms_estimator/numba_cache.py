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
_FILE: Any = IndexDataCacheFile
_DUMP, _LOAD = _FILE._dump, _FILE._load_data  # noqa: SLF001 - numba has no other place for a check
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

    None without any.
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
            with contextlib.suppress(OSError, RuntimeError):  # the latter of a user without a home
                folder = Path(candidate).expanduser() / digest.hexdigest()[:16]
                folder.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    return None


@contextlib.contextmanager
def _go_on(cache: Any) -> Iterator[None]:
    """Context of each use of a kernel's files: any error costs only a compilation."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"compiled kernels are not kept: {error.strerror}", RuntimeWarning, stacklevel=1)
    except Exception as error:  # noqa: BLE001 - a damaged file may raise anything
        warnings.warn(f"a compiled kernel cannot be read: {error!r}", RuntimeWarning, stacklevel=1)
        with contextlib.suppress(OSError):
            cache.flush()


def _sealed(file: Any, kernel: Any) -> bytes:
    """Append the digest to a cached kernel, or to the list of them."""
    content: bytes = _DUMP(file, kernel)
    return content + hashlib.sha256(content).digest()


def _opened(file: Any, name: str) -> Any:
    """Read a cached kernel and verify its digest.

    Raises:
        ValueError: The file is not as it was written.
    """
    kept = Path(file._data_path(name)).read_bytes()  # noqa: SLF001 - as numba's own method has it
    if hashlib.sha256(kept[:-DIGEST_BYTES]).digest() != kept[-DIGEST_BYTES:]:
        raise ValueError(f"{name} is damaged")
    return _LOAD(file, name)


def _keep(folder: Path | None) -> None:
    """Have numba keep compiled kernels in ``folder``."""
    cache: Any = Cache  # methods of both are replaced, which the types do not express
    kernel: Any = Dispatcher
    if folder is None:
        warnings.warn("compiled kernels are not kept: no folder can be written", RuntimeWarning, stacklevel=1)
        kernel.enable_caching = lambda _: None
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    cache._guard_against_spurious_io_errors = _go_on  # noqa: SLF001 - numba's place for it, empty but on Windows
    _FILE._dump, _FILE._load_data = _sealed, _opened  # noqa: SLF001


_keep(_cache_folder())
