"""Compile kernels once for each signature, with a disk cache that notices every changed source file.

numba checks only the file of the compiled function. It does not notice a change in the files of the functions that the
kernel calls, or of the constants that it compiles in. Therefore the cache folder carries a hash of all these files. All
installations of a version share the folder.

Every kernel imports ``njit`` from here: importing it sets the cache folder. If the cache cannot be written or read,
kernels are compiled at each start. Each cached file ends with a digest, because machine code damaged by a power cut
would run.
"""

import contextlib
import fcntl
import functools
import hashlib
import importlib
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeVar, cast

import numba
from numba import types
from numba.core.caching import Cache, CompileResultCacheImpl, IndexDataCacheFile, _CacheLocator
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

__all__ = [
    "CACHE_FOLDER",
    "COMPILED_IN",
    "cache_folders",
    "count_cached_kernels",
    "count_kernels",
    "njit",
    "source_digest",
]

Function = TypeVar("Function", bound=Callable[..., Any])
DIGEST_BYTES = 32
LOCK_FILE = "lock"
"""File in the cache folder. A process that compiles a kernel locks one byte of this file. Its offset is a hash of the
kernel's name."""
OFFSET_BYTES = 7
"""Length of the hash that is the offset of a lock [bytes]. It is long enough that two kernels have different offsets, and
short enough for a file offset of 63 bits."""
# Any, because methods of these classes are replaced below
_Cache: Any = Cache
_CacheFile: Any = IndexDataCacheFile
_CacheImpl: Any = CompileResultCacheImpl
_Dispatcher: Any = Dispatcher
_numba_njit: Any = numba.njit  # its stubs lack no_cfunc_wrapper
_unliteral: Any = types.unliteral
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
            "model/unmeasured_time.py",
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


def njit(**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator of the same name, without two features that cost compile time and that no kernel needs.

    numba compiles a kernel again for each constant among the arguments of a call, although the optimizer inserts the
    constant anyway. It also compiles an entry point for callers in C.

    While one process compiles a kernel, other processes that need it wait and then load it from the cache.
    """

    def decorate(function: Function) -> Function:
        kernel: Any = _numba_njit(no_cfunc_wrapper=True, **options)(function)
        numba_template, numba_compile = kernel.get_call_template, kernel.compile
        name = f"{function.__module__}.{function.__qualname__}"

        def get_call_template(args: Any, keywords: Any) -> Any:
            return numba_template(
                [_unliteral(type_) for type_ in args],
                {keyword: _unliteral(type_) for keyword, type_ in keywords.items()},
            )

        def compile_or_wait(signature: Any) -> Any:
            # numba's lock of this process comes first, so that no other thread waits for it with the kernel locked
            with global_compiler_lock, _kernel_lock(name):
                _import_without_blas()
                return numba_compile(signature)

        kernel.get_call_template, kernel.compile = get_call_template, compile_or_wait
        return cast("Function", kernel)

    return decorate


def source_digest() -> str:
    """Return a hash of numba's version and all files in ``COMPILED_IN``, the name of a folder within a cache folder."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in COMPILED_IN:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cache_folders() -> list[Path]:
    """Return the cache folders in the order of preference: NUMBA_CACHE_DIR, systemd's CacheDirectory, the user's cache."""
    home_cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    candidates = [
        os.environ.get("NUMBA_CACHE_DIR"),
        os.environ.get("CACHE_DIRECTORY"),
        f"{home_cache}/bms_estimator",
    ]
    folders = []
    for candidate in filter(None, candidates):
        with contextlib.suppress(RuntimeError):  # the user has no home folder
            folders.append(Path(candidate).expanduser())
    return folders


def _cache_folder() -> Path | None:
    """Return this version's folder in the first cache folder that can be written; None without one."""
    digest = source_digest()
    for folder in cache_folders():
        with contextlib.suppress(OSError):
            version_folder = folder / digest
            version_folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=version_folder).close()
            return version_folder
    return None


def count_kernels() -> int:
    """Return the number of kernels of this version."""
    return sum(source.read_text(encoding="utf-8").count("\n@njit(") for source in COMPILED_IN)


def count_cached_kernels() -> int:
    """Return the number of kernels in the cache, also of those that other processes have compiled."""
    if CACHE_FOLDER is None:
        return 0
    folders = {source.parent.relative_to(_PACKAGE) for source in COMPILED_IN}
    return sum(1 for folder in folders for _ in (CACHE_FOLDER / folder).glob("*.nbi"))


@functools.cache
def _kernel_folder(source: str) -> str | None:
    """Return the folder of a source file's kernels, below the cache folder. Create it if it does not exist.

    Return None for a file of another package, or if the folder cannot be written.
    """
    file = Path(source)
    if not file.is_relative_to(_PACKAGE):
        return None
    folder = Path(numba.config.CACHE_DIR) / file.parent.relative_to(_PACKAGE)  # type: ignore[attr-defined]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return None
    return str(folder)


class _PackageLocator(_CacheLocator):
    """Place of a kernel of this package in the cache.

    numba's own locators use the absolute path of the source file, so that each installation would compile the kernels again.
    They also examine the folder again for each kernel of a file.
    """

    def __init__(self, function: Callable[..., Any], source: str, folder: str) -> None:
        self._py_file = source  # the name that numba uses in its warnings
        self._line = function.__code__.co_firstlineno
        self._folder = folder

    @classmethod
    def from_function(cls, function: Callable[..., Any], source: str) -> Self | None:
        """Return the place; None for a function of another package, or if the folder cannot be written."""
        folder = _kernel_folder(source)
        return None if folder is None else cls(function, source, folder)

    def get_cache_path(self) -> str:
        """Return the folder of the source file within the package, below the cache folder."""
        return self._folder

    def get_source_stamp(self) -> str:
        """Return the same value for all files, because the name of the cache folder contains the hash of the sources."""
        return ""

    def get_disambiguator(self) -> str:
        """Return the line of the function, which distinguishes functions of the same name."""
        return str(self._line)


@functools.cache
def _import_without_blas() -> None:
    """Import numba's array functions without ``scipy.linalg``, whose import takes a fifth of the time to load the kernels.

    numba imports it to find out whether a BLAS exists. No kernel uses one. Without it, ``numpy.correlate`` and
    ``numpy.convolve`` in compiled code of other packages use a loop.
    """
    linalg: Any = importlib.import_module("numba.np.linalg")
    ensure_blas, linalg.ensure_blas = linalg.ensure_blas, _deny_blas
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = ensure_blas


def _deny_blas() -> None:
    raise ImportError("no kernel uses a BLAS")


@contextlib.contextmanager
def _kernel_lock(name: str) -> Iterator[None]:
    """Exclude other processes from compiling the kernel ``name``. Without a cache folder, do nothing.

    A kernel locks the kernels that it calls, never the other way round, so that no two processes wait for each other.
    The lock ends with the process.
    """
    if _lock_file is None:
        yield
        return
    offset = int.from_bytes(hashlib.sha256(name.encode()).digest()[:OFFSET_BYTES])
    with contextlib.suppress(OSError):  # a file system without locks: both processes compile the kernel
        fcntl.lockf(_lock_file, fcntl.LOCK_EX, 1, offset)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.lockf(_lock_file, fcntl.LOCK_UN, 1, offset)


@contextlib.contextmanager
def _warn_on_cache_error(cache: Any) -> Iterator[None]:
    """Turn errors of the cache into warnings: numba then compiles the kernel instead of loading it."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"compiled kernels are not stored: {error.strerror}", RuntimeWarning, stacklevel=1)
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
        warnings.warn("compiled kernels are not stored: no folder can be written", RuntimeWarning, stacklevel=1)
        _Dispatcher.enable_caching = lambda _: None
        return
    numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    _CacheImpl._locator_classes.insert(0, _PackageLocator)  # noqa: SLF001 - numba has no public function for it
    # numba's context manager around each access to the cache; numba's own does nothing except on Windows
    _Cache._guard_against_spurious_io_errors = _warn_on_cache_error  # noqa: SLF001
    _CacheFile._dump, _CacheFile._load_data = _dump_with_digest, _load_verified  # noqa: SLF001


def _open_lock_file(folder: Path | None) -> BinaryIO | None:
    """Open the file for the locks of kernels; None if there is no cache."""
    if folder is not None:
        with contextlib.suppress(OSError):
            return (folder / LOCK_FILE).open("ab")
    return None


CACHE_FOLDER = _cache_folder()
"""Folder of compiled kernels; None if no folder can be written."""
_lock_file = _open_lock_file(CACHE_FOLDER)
_enable_disk_cache(CACHE_FOLDER)
