"""Callbacks on compilation: a first start takes a minute or two, later ones load kernels from the cache."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType

from numba.core import event
from numba.core.dispatcher import Dispatcher

PACKAGE = __name__.partition(".")[0]

CompileCallback = Callable[[str, int, int], None]
"""Gets a kernel's name, how many kernels have begun with it, and how many there are at most."""


@contextmanager
def report_compilation(tell: CompileCallback) -> Iterator[None]:
    """Call ``tell`` for each imported kernel whose compilation begins meanwhile."""
    with event.install_listener("numba:compile", _Listener(_kernels(), tell)):
        yield


def _kernels() -> set[FunctionType]:
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{PACKAGE}.")]
    return {each.py_func for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}


def _name(kernel: FunctionType) -> str:
    """``file: function`` in words."""
    return f"{kernel.__module__.rpartition('.')[2]}: {kernel.__name__}".replace("_", " ")


class _Listener(event.Listener):
    """Listener for functions that numba begins to compile; cached ones are not reported."""

    def __init__(self, kernels: set[FunctionType], tell: CompileCallback) -> None:
        self._waiting, self._all, self._tell = kernels, len(kernels), tell

    def on_start(self, event: event.Event) -> None:
        """Count a kernel of this package; inner functions follow their callers."""
        kernel = event.data["dispatcher"].py_func
        if kernel in self._waiting:  # a kernel is compiled for each type of argument
            self._waiting.remove(kernel)
            self._tell(_name(kernel), self._all - len(self._waiting), self._all)

    def on_end(self, event: event.Event) -> None:
        """Do nothing: the end of a compilation is not needed."""
