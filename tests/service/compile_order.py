"""Record the kernels of a first start: ``make compile-order``.

The kernels that call no other come first, then those that call only these, and so on. Thus two children seldom wait for each other.
"""

import dis
import functools
import time

from numba import types
from numba.core import event
from numba.core.dispatcher import Dispatcher

from bms_estimator.service import kernel_warm_up
from bms_estimator.service.kernel_compilation import ORDER_FILE, argument_types


class Recorder(event.Listener):
    """Listener that records each compiled kernel at the end of its compilation."""

    def __init__(self):
        self.lines, self._begins = [], []
        self._names = {record: name for name, record in argument_types().items() if isinstance(record, types.Record)}

    def on_start(self, _):
        self._begins.append([time.process_time(), 0.0])

    def on_end(self, ended):
        begin, of_callees = self._begins.pop()
        duration = time.process_time() - begin
        if self._begins:
            self._begins[-1][1] += duration
        function, arguments = ended.data["dispatcher"].py_func, ended.data["args"]
        package, _, module = function.__module__.partition(".")
        if package == "bms_estimator":
            texts = ", ".join(text(each, self._names) for each in arguments)
            call = f"{module}.{function.__qualname__} ({texts}{',' if texts else ''})"
            self.lines.append((levels_below(ended.data["dispatcher"]), f"{duration - of_callees:.2f} {call}"))


def callees(kernel):
    """Return the kernels that a kernel calls."""
    function = kernel.py_func
    names = {each.argval for each in dis.get_instructions(function) if each.opname == "LOAD_GLOBAL"}
    return [each for name in names if isinstance(each := function.__globals__.get(name), Dispatcher)]


@functools.cache
def levels_below(kernel):
    """Return the number of levels of kernels that a kernel calls."""
    return max((1 + levels_below(each) for each in callees(kernel)), default=0)


def text(argument, names):
    """Return a type of numba as an expression of names in ``numba.types`` and of constants of the package."""
    if isinstance(argument, types.Record):
        return names[argument]
    if isinstance(argument, types.NestedArray):
        return f"NestedArray({text(argument.dtype, names)}, {argument.shape})"
    if isinstance(argument, types.Array):
        readonly = "" if argument.mutable else ", readonly=True"
        return f"Array({text(argument.dtype, names)}, {argument.ndim}, {argument.layout!r}{readonly})"
    if isinstance(argument, types.UniTuple):
        return f"UniTuple({text(argument.dtype, names)}, {argument.count})"
    return "boolean" if argument == types.boolean else str(argument)


def main():
    recorder = Recorder()
    with event.install_listener("numba:compile", recorder):
        kernel_warm_up._call_kernels()
    ORDER_FILE.write_text("".join(f"{line}\n" for _, line in sorted(recorder.lines, key=lambda each: each[0])))


if __name__ == "__main__":
    main()
