"""Pure numerical kernels (numba): no I/O, no clock, no Python objects.

numba's disk cache notices a change in a function's own file only, not in the files of the functions it calls, nor in
those of the constants it compiles in, and would go on running the old ones. So the cache lives in a folder named by the
content of all of them.

A kernel that cannot be kept there, or cannot be read from there, is compiled at each start: a full disk ends nothing.
Machine code with zeros in its middle, as a power cut leaves, would run: what is kept ends with its digest.
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
from numba.core.caching import Cache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

DIGEST_BYTES = 32
_FILE: Any = IndexDataCacheFile
_DUMP, _LOAD = _FILE._dump, _FILE._load_data  # noqa: SLF001 - numba has no other place for a check
_HERE = Path(__file__).parent
_PACKAGE = _HERE.parent
COMPILED_IN = (
    *sorted(_HERE.glob("*.py")),
    *sorted((_PACKAGE / "sources" / "wire").glob("*.py")),
    *(_PACKAGE / constants for constants in ("model/sample.py", "model/suspect.py", "sources/protocol.py")),
)
"""Files that compiled code is made of: the kernels, what decodes the line, and what they take constants from."""


def _cache_folder() -> Path | None:
    """Where compiled kernels go: NUMBA_CACHE_DIR, systemd's CacheDirectory, or the user's cache; None: nowhere."""
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
    """Around each use of a kernel's files: whatever is wrong with them, it costs the compilation only."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"compiled kernels are not kept: {error.strerror}", RuntimeWarning, stacklevel=1)
    except Exception as error:  # noqa: BLE001 - a damaged file may raise anything
        warnings.warn(f"a compiled kernel cannot be read: {error!r}", RuntimeWarning, stacklevel=1)
        with contextlib.suppress(OSError):
            cache.flush()


def _sealed(file: Any, kernel: Any) -> bytes:
    """What is kept of a kernel, or of the list of them: numba's content, which tells its own end, and its digest."""
    content: bytes = _DUMP(file, kernel)
    return content + hashlib.sha256(content).digest()


def _opened(file: Any, name: str) -> Any:
    """A kernel that was kept.

    Raises:
        ValueError: The file is not as it was written.
    """
    kept = Path(file._data_path(name)).read_bytes()  # noqa: SLF001 - as numba's own method has it
    if hashlib.sha256(kept[:-DIGEST_BYTES]).digest() != kept[-DIGEST_BYTES:]:
        raise ValueError(f"{name} is damaged")
    return _LOAD(file, name)


def _keep(folder: Path | None) -> None:
    """Have numba keep compiled kernels in ``folder``."""
    cache: Any = Cache  # methods of both are replaced, which types do not know
    kernel: Any = Dispatcher
    if folder is None:
        warnings.warn("compiled kernels are not kept: no folder can be written", RuntimeWarning, stacklevel=1)
        kernel.enable_caching = lambda _: None
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    cache._guard_against_spurious_io_errors = _go_on  # noqa: SLF001 - numba's place for it, empty but on Windows
    _FILE._dump, _FILE._load_data = _sealed, _opened  # noqa: SLF001


_keep(_cache_folder())
