"""Who hears what is being compiled: a first start takes a minute or two, later ones load it from the cache."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event
from numba.core.dispatcher import Dispatcher

PACKAGE = __name__.rpartition(".")[0]

Tell = Callable[[str, int, int], None]
"""Gets a kernel's name, how many kernels have begun with it, and how many there are at most."""


@contextmanager
def compiling_told(tell: Tell) -> Iterator[None]:
    """Have ``tell`` hear of each kernel whose compilation begins meanwhile, among the kernels imported so far."""
    with event.install_listener("numba:compile", _Listener(_kernels(), tell)):
        yield


def _kernels() -> set[str]:
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{PACKAGE}.")]
    return {_name(each) for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}


def _name(kernel: Dispatcher) -> str:
    """``file: function`` in words."""
    function = kernel.py_func
    return f"{function.__module__.removeprefix(f'{PACKAGE}.')}: {function.__name__}".replace("_", " ")


class _Listener(event.Listener):
    """numba tells which function it begins to compile; one that comes from the cache is not told."""

    def __init__(self, kernels: set[str], tell: Tell) -> None:
        self._waiting, self._all, self._tell = kernels, len(kernels), tell

    def on_start(self, event: event.Event) -> None:
        """A function, ours or numba's own; inner ones come after those that call them."""
        name = _name(event.data["dispatcher"])
        if name in self._waiting:  # a kernel is compiled anew for each kind of argument
            self._waiting.remove(name)
            self._tell(name, self._all - len(self._waiting), self._all)

    def on_end(self, event: event.Event) -> None:
        """Nobody asks."""
