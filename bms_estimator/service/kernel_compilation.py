"""Compilation of the kernels in child processes, which end before they take much memory.

numba does not free the memory of a compilation before its process ends. Children therefore compile the kernels of a
recorded order, one after the other, and write them to the cache of ``numba_cache``. A child ends when it has grown to
``MAX_CHILD_BYTES``, and another one continues. Afterwards the program loads the kernels from the cache.
"""

import contextlib
import importlib
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
from numba import from_dtype, types

from bms_estimator.model.errors import TemporaryError
from bms_estimator.numba_cache import CACHE_FOLDER, SHIPPED_FOLDER
from bms_estimator.process.memory import anonymous_bytes, available_bytes
from bms_estimator.process.systemd import extend_start

ORDER_FILE = Path(__file__).with_name("compile_order.txt")
"""File with the kernels of a first start, callees before callers. A line has CPU time [s], name and argument types.
``make compile-order`` writes it."""
MAX_CHILD_BYTES = 144 * 2**20
"""Anonymous memory above which a child ends [bytes]. One kernel adds at most 25 MiB."""
CHILD_BYTES = 256 * 2**20
"""Available memory that is required for each child [bytes]."""
MAX_FAILURES = 3
"""Number of successive children that compile no kernel, for example for lack of memory, after which the compilation fails."""
REPORT_INTERVAL_S = 0.5
"""Interval between two reports of the progress [s]."""
COMPLETE_FILE = f"complete-py{sys.version_info[0]}{sys.version_info[1]}-{os.uname().machine}"
"""Marker file: a folder that has it contains all kernels for this version of Python and this architecture."""


class Progress(NamedTuple):
    """Progress of a compilation."""

    kernels: int
    """Number of kernels that are compiled."""
    all_kernels: int
    cpu_s: float
    """Recorded CPU time of the kernels that are compiled [s]."""
    all_cpu_s: float


Report = Callable[[Progress], None]
"""Function that receives the progress."""


class Kernel(NamedTuple):
    """Kernel of the recorded order."""

    cpu_s: float
    """Recorded CPU time of its compilation, without the kernels that it calls [s]."""
    call: str
    """Name and types of the arguments, such as ``kernels.accumulators.history.needs_caller (HISTORY,)``."""


def compile_order() -> list[Kernel]:
    """Return the kernels in the recorded order. A kernel follows the kernels that it calls."""
    lines = (line.split(" ", 1) for line in ORDER_FILE.read_text(encoding="utf-8").splitlines())
    return [Kernel(float(seconds), call) for seconds, call in lines]


def is_compiled() -> bool:
    """Return True if all kernels were compiled, or if there is no folder for them."""
    return CACHE_FOLDER is None or any((folder / COMPLETE_FILE).exists() for folder in (SHIPPED_FOLDER, CACHE_FOLDER))


def compile_kernels(report: Report = lambda _: None, stop: threading.Event | None = None) -> None:
    """Compile all kernels that are not in the cache, in as many children as CPUs and memory allow.

    Args:
        report: Called with the progress, in the calling thread. An exception that it raises ends the compilation.
        stop: Event that ends a compilation in the background, whose children have the lowest priority, and write nothing to
            stderr; None: the compilation is not in the background.

    Raises:
        TemporaryError: The children end early.
    """
    if CACHE_FOLDER is None or is_compiled():
        return
    order = compile_order()
    pending, done = deque(order), list[Kernel]()
    count = max(1, min(len(os.sched_getaffinity(0)), available_bytes() // CHILD_BYTES))
    compilers = [_Compiler(pending, done, in_background=stop is not None) for _ in range(count)]
    try:
        for compiler in compilers:
            compiler.start()
        while running := [compiler for compiler in compilers if compiler.is_alive()]:
            if stop and stop.is_set():
                return
            report(Progress(len(done), len(order), sum(each.cpu_s for each in done), sum(each.cpu_s for each in order)))
            extend_start(f"compiling kernels: {len(done)} of {len(order)}")
            running[0].join(REPORT_INTERVAL_S)
    finally:
        for compiler in compilers:
            compiler.stop()
    if len(done) < len(order):
        raise TemporaryError(
            f"the kernels cannot be compiled: the compiler ended {MAX_FAILURES} times; it needs {CHILD_BYTES >> 20} MiB "
            f"of memory, and {available_bytes() >> 20} MiB are available"
        )
    (CACHE_FOLDER / COMPLETE_FILE).touch()


@contextlib.contextmanager
def background_compilation() -> Iterator[Callable[[Report], None]]:
    """Compile the kernels in the background, for example while a user answers questions, until the context ends.

    Yields:
        Function that waits for the end of the compilation, with the argument and the exception of ``compile_kernels``. A
        compilation that failed in the background is repeated.
    """
    latest, stop = deque[Progress](maxlen=1), threading.Event()
    with ThreadPoolExecutor(1) as executor:
        compiling = executor.submit(compile_kernels, latest.append, stop)

        def finish(report: Report) -> None:
            while wait([compiling], REPORT_INTERVAL_S).not_done:
                if latest:
                    report(latest[0])
            compile_kernels(report)

        try:
            yield finish
        finally:
            stop.set()


class _Compiler(threading.Thread):
    """Thread that passes kernels to one child after the other."""

    def __init__(self, pending: deque[Kernel], done: list[Kernel], *, in_background: bool) -> None:
        super().__init__(daemon=True)
        self._pending, self._done, self._in_background = pending, done, in_background
        self._lock, self._stopped = threading.Lock(), False
        self._child: subprocess.Popen[str] | None = None

    def run(self) -> None:
        """Compile the pending kernels."""
        failures = 0
        kernel = self._next()
        while kernel and failures < MAX_FAILURES and (child := self._start_child()):
            done_before = len(self._done)
            with contextlib.suppress(BrokenPipeError), child:  # the child ended, and closing its input fails
                kernel = self._compile_in(child, kernel)
            failures = failures + 1 if len(self._done) == done_before else 0
        if kernel:
            self._pending.append(kernel)

    def _compile_in(self, child: subprocess.Popen[str], kernel: Kernel | None) -> Kernel | None:
        """Compile kernels until the child ends or no kernel is pending; return the kernel that the child did not compile."""
        stdin, stdout = cast("IO[str]", child.stdin), cast("IO[str]", child.stdout)
        while kernel:
            with contextlib.suppress(BrokenPipeError):  # the child ended
                stdin.write(f"{kernel.call}\n")
                stdin.flush()
            if not stdout.readline():
                return kernel
            self._done.append(kernel)
            kernel = self._next()
        stdin.close()
        return None

    def _next(self) -> Kernel | None:
        with contextlib.suppress(IndexError):
            return self._pending.popleft()
        return None

    def _start_child(self) -> subprocess.Popen[str] | None:
        with self._lock:
            if self._stopped:
                return None
            self._child = subprocess.Popen(  # noqa: S603 - this module
                [
                    *(["nice", "-n19"] if self._in_background else []),
                    sys.executable,
                    "-P",
                    "-m",
                    __name__,
                    str(MAX_CHILD_BYTES),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL if self._in_background else None,
                text=True,
                start_new_session=True,  # Ctrl-C in the terminal ends only this process, which ends its children
            )
        return self._child

    def stop(self) -> None:
        """End the child and the thread."""
        with self._lock:
            self._stopped = True
            if self._child:
                self._child.kill()
        if self.ident is not None:  # Ctrl-C may come before the thread is started
            self.join()


def argument_types() -> dict[str, Any]:
    """Return the types of numba, and those of the package's structured dtypes by the names of their constants."""
    importlib.import_module("bms_estimator.service.kernel_warm_up")  # all modules with kernels
    modules = [module for name, module in sorted(sys.modules.items()) if name.startswith("bms_estimator.")]
    constants = (item for module in modules for item in vars(module).items() if item[0].isupper())
    records = {name: value for name, value in constants if isinstance(value, np.dtype) and value.names}
    return vars(types) | {name: from_dtype(record) for name, record in records.items()}


def compile_call(call: str, types_by_name: dict[str, Any]) -> None:
    """Compile a kernel for the types of its arguments, or load it from the cache.

    Args:
        call: Name and types, as in ``Kernel``.
        types_by_name: Types by the names that ``call`` uses.
    """
    name, arguments = call.split(" ", 1)
    module, function = name.rsplit(".", 1)
    kernel = getattr(importlib.import_module(f"bms_estimator.{module}"), function)
    kernel.compile(eval(arguments, types_by_name))  # noqa: S307 - a file of this package


def _compile_calls(calls: Iterator[str], max_bytes: int) -> None:
    """Compile kernels, and write a line to stdout after each. End when this process has more than ``max_bytes`` of memory."""
    types_by_name = argument_types()
    for call in calls:
        with contextlib.suppress(Exception):  # a kernel of an outdated order; the program compiles what is missing
            compile_call(call, types_by_name)
        sys.stdout.write("\n")
        sys.stdout.flush()
        if anonymous_bytes() > max_bytes:
            return


if __name__ == "__main__":
    _compile_calls(iter(sys.stdin), int(sys.argv[1]))
