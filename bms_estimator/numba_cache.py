"""Compile kernels once for each signature, with a disk cache that notices every changed source file.

numba checks only the file of the compiled function. It does not notice a change in the files of the functions that the
kernel calls, or of the constants that it compiles in. Therefore the cache folder carries a hash of all these files. All
installations of a version share the folder.

Kernels are compiled for the generic CPU of an architecture. Compiled kernels therefore run on every machine of the
architecture, with the same results to the last bit. Packages and images contain them in ``SHIPPED_FOLDER``, which is only
read.

Every kernel imports ``njit`` from here. If the cache cannot be written or read, kernels are compiled at each start. Each
cached file ends with a digest, because machine code damaged by a power cut would run.
"""

import contextlib
import fcntl
import functools
import hashlib
import importlib
import os
import pickle
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeVar, cast

import numba
from numba import types
from numba.core.caching import CompileResultCacheImpl, NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.serialize import dumps

__all__ = [
    "CACHE_FOLDER",
    "COMPILED_SOURCES",
    "SHIPPED_FOLDER",
    "cache_folders",
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
_numba_njit: Any = numba.njit  # its stubs lack no_cfunc_wrapper
_unliteral: Any = types.unliteral
_rebuild: Any = CompileResultCacheImpl.rebuild
_dumps: Any = dumps
_PACKAGE = Path(__file__).parent
COMPILED_SOURCES = (
    *sorted((_PACKAGE / "kernels").rglob("*.py")),
    *(
        _PACKAGE / file
        for file in (
            "model/arrays.py",
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
# Set before the first kernel is compiled, because numba then chooses the target. Without the empty list of features, numba
# would add those of this machine's CPU.
os.environ |= {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
numba.config.reload_config()  # type: ignore[no-untyped-call]


def njit(*, cache: bool = False, **options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator of the same name, without two features that cost compile time and that no kernel needs.

    numba compiles a kernel again for each constant among the arguments of a call, although the optimizer inserts the
    constant anyway. It also compiles an entry point for callers in C.

    While one process compiles a kernel, other processes that need it wait and then load it from the cache.
    """

    def decorate(function: Function) -> Function:
        kernel: Any = _numba_njit(no_cfunc_wrapper=True, **options)(function)
        numba_template, numba_compile = kernel.get_call_template, kernel.compile
        name = f"{function.__module__}.{function.__qualname__}"
        if cache:
            kernel._cache = _KernelCache(function)  # noqa: SLF001 - numba has no public function for another cache

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
    """Return the name of this version's folder in a cache folder: a hash of numba's version and the files in ``COMPILED_SOURCES``."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in COMPILED_SOURCES:
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
    for folder in cache_folders():
        with contextlib.suppress(OSError):
            version_folder = folder / _DIGEST
            version_folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=version_folder).close()
            return version_folder
    warnings.warn("compiled kernels are not stored: no folder can be written", RuntimeWarning, stacklevel=1)
    return None


class _KernelCache(NullCache):
    """Cache of a kernel, in one file for each signature and minor version of Python.

    numba's own cache depends on the absolute path of the source file, so that each installation would compile the kernels
    again, and it has one folder, which must be writable. The file of a kernel outside this package carries a hash of its source
    file. Such a kernel may call kernels of that file and of this package.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        code, source = function.__code__, Path(function.__code__.co_filename)
        name = (
            f"{source.stem}.{function.__qualname__}-{code.co_firstlineno}.py{sys.version_info[0]}{sys.version_info[1]}"
        )
        self._path = (
            source.parent.relative_to(_PACKAGE)
            if source.is_relative_to(_PACKAGE)
            else Path("outside", hashlib.sha256(source.read_bytes()).hexdigest()[:16])
        ) / name

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled kernel; None if it must be compiled."""
        context.refresh()  # registers numba's built-in functions for the target
        for folder in (SHIPPED_FOLDER, CACHE_FOLDER):
            path = self._file(folder, signature, context.codegen())
            if path is not None:
                with _warn_on_error("a compiled kernel cannot be read"), contextlib.suppress(FileNotFoundError):
                    return _rebuild(None, context, pickle.loads(_read_verified(path)))  # noqa: S301 - our own file
        return None

    def save_overload(self, signature: Any, kernel: Any) -> None:
        """Write a compiled kernel. An interrupted process leaves no damaged file."""
        path = self._file(CACHE_FOLDER, signature, kernel.library.codegen)
        if path is None or kernel.library.has_dynamic_globals:  # the code contains addresses of this process
            return
        content: bytes = _dumps(kernel._reduce())  # noqa: SLF001 - as in numba's own cache
        with _warn_on_error("compiled kernels are not stored"):
            path.parent.mkdir(parents=True, exist_ok=True)
            new = path.with_name(f"{path.name}.tmp.{os.getpid()}")
            try:
                new.write_bytes(content + hashlib.sha256(content).digest())
                new.replace(path)
            finally:
                new.unlink(missing_ok=True)

    def _file(self, folder: Path | None, signature: Any, codegen: Any) -> Path | None:
        """Return the file of a signature's machine code; None without a folder."""
        if folder is None:
            return None
        key = hashlib.sha256(repr((tuple(signature), codegen.magic_tuple())).encode()).hexdigest()[:16]
        return folder / f"{self._path}.{key}.nbc"


def _read_verified(path: Path) -> bytes:
    """Return the content of a cached kernel without its digest.

    Raises:
        ValueError: The file was changed after it was written.
    """
    stored = path.read_bytes()
    content, digest = stored[:-DIGEST_BYTES], stored[-DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError(f"{path.name} is damaged")
    return content


@contextlib.contextmanager
def _warn_on_error(text: str) -> Iterator[None]:
    """Turn errors of the cache into warnings: numba then compiles the kernel instead of loading it."""
    try:
        yield
    except OSError as error:
        warnings.warn(f"{text}: {error.strerror}", RuntimeWarning, stacklevel=1)
    except Exception as error:  # noqa: BLE001 - a damaged file may raise anything
        warnings.warn(f"{text}: {error!r}", RuntimeWarning, stacklevel=1)


@functools.cache
def _import_without_blas() -> None:
    """Import numba's array functions without ``scipy.linalg``, whose import takes a fifth of the time to load the kernels.

    numba imports ``scipy.linalg`` to find out whether a BLAS exists. No kernel uses a BLAS. Without a BLAS, ``numpy.correlate``
    and ``numpy.convolve`` in compiled code of other packages use a loop.
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

    A process that compiles a kernel also locks the kernels that it calls, but never its callers. Therefore no two processes
    wait for each other.
    The system releases the lock when the process ends.
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


def _open_lock_file(folder: Path | None) -> BinaryIO | None:
    """Open the file for the locks of kernels; None if there is no cache."""
    if folder is not None:
        with contextlib.suppress(OSError):
            return (folder / LOCK_FILE).open("ab")
    return None


_DIGEST = source_digest()
SHIPPED_FOLDER = _PACKAGE / "compiled" / _DIGEST
"""Read-only folder of the compiled kernels that a package or an image contains. It may not exist."""
CACHE_FOLDER = _cache_folder()
"""Folder of the kernels that this machine compiles; None if no folder can be written."""
_lock_file = _open_lock_file(CACHE_FOLDER)
