"""Callback for each compiled kernel. The first start compiles for a minute or two; later starts load kernels from the cache."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType

from numba.core import event
from numba.core.dispatcher import Dispatcher

PACKAGE = __name__.partition(".")[0]
"""Name of the top-level package."""

CompileCallback = Callable[[str, int, int], None]
"""Callback with a kernel's name, the number of kernels started so far, and the maximum number of kernels."""


@contextmanager
def report_compilation(on_kernel: CompileCallback) -> Iterator[None]:
    """Call ``on_kernel`` for each imported kernel whose compilation starts within the context."""
    with event.install_listener("numba:compile", _Listener(_kernels(), on_kernel)):
        yield


def _kernels() -> set[FunctionType]:
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{PACKAGE}.")]
    return {each.py_func for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}


def _name(kernel: FunctionType) -> str:
    """Return "file: function" with spaces for underscores."""
    return f"{kernel.__module__.rpartition('.')[2]}: {kernel.__name__}".replace("_", " ")


class _Listener(event.Listener):
    """Listener for functions that numba compiles. Cached functions cause no event."""

    def __init__(self, kernels: set[FunctionType], on_kernel: CompileCallback) -> None:
        self._pending, self._total, self._on_kernel = kernels, len(kernels), on_kernel

    def on_start(self, event: event.Event) -> None:
        """Report a kernel of this package once."""
        kernel = event.data["dispatcher"].py_func
        if kernel in self._pending:  # numba compiles a kernel once for each set of argument types
            self._pending.remove(kernel)
            self._on_kernel(_name(kernel), self._total - len(self._pending), self._total)

    def on_end(self, event: event.Event) -> None:
        """Do nothing, because only the start of a compilation is reported."""
