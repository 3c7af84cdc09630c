"""Where the package asks the machine for time, chance or a moment it asks the world instead.

Nothing of the package is written for that: whatever it has bound of the standard library's clocks and dice, as a
module, a function or a default argument, is bound anew while the world lasts, in all its modules.
"""

import contextlib
import functools
import os
import random
import secrets
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Thread
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from bms_estimator.model import clock
from bms_estimator.process import boot_clock as moment
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.telemetry import health
from tests.world.disk import Disk
from tests.world.threads import Threads

PACKAGE = "bms_estimator"


class Clocks:
    """The world's clocks: one that may be stepped, two that may not, and which start of the machine it is."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self.wall_offset_s = 1.7e9
        self.synchronised = True
        self.boot = "first"
        self.booted_s = 0.0
        self.asleep_s = 0.0

    def wall(self) -> float:
        return self._now() + self.wall_offset_s

    def since_boot(self) -> float:
        return self._now() - self.booted_s

    def monotonic(self) -> float:
        return self.since_boot() - self.asleep_s

    def moment(self) -> moment.BootTimestamp:
        return moment.BootTimestamp(self.wall(), self.synchronised, self.since_boot(), self.boot)


class _Instead:
    """A module of which some functions are other ones."""

    def __init__(self, module: ModuleType, **functions: Any) -> None:
        self._module = module
        self.__dict__.update(functions)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


SLOWER = (("service.live_loop", "LAG_STEP_S", 2.0), ("sources.serial.serial_source", "SEND_INTERVAL_S", 0.5))
"""What looks around all the time does so less often: module, name, seconds. It is what an idle hour would cost most."""
REMEMBERED = (("estimator.settings_records", "decay_table"),)
"""Pure functions whose values are worth keeping from start to start."""


@functools.cache
def _remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    return functools.cache(function)


@contextlib.contextmanager
def seams(clocks: Clocks, dice: random.Random, threads: Callable[[], Threads], disk: Disk) -> Iterator[None]:
    """Have the package ask ``clocks`` and ``dice``, and ``threads`` and ``disk`` for what runs beside the loop."""
    instead: dict[int, Any] = {
        id(time.time): clocks.wall,
        id(time.monotonic): clocks.monotonic,
        id(time.perf_counter): clocks.monotonic,
        id(clock.since_boot): clocks.since_boot,
        id(moment.boot_timestamp): clocks.moment,
        id(random.uniform): dice.uniform,
        id(random.random): dice.random,
        id(ThreadPoolExecutor): lambda *args, **named: threads().executor(*args, **named),
        id(DiskThread): lambda name: threads().executor(thread_name_prefix=name),
        id(Thread): lambda **named: threads().thread(**named),
        id(sqlite3): _Instead(sqlite3, connect=disk.connect),
        id(secrets.token_hex): lambda count: dice.randbytes(count).hex(),
        id(time): _Instead(
            time, time=clocks.wall, monotonic=clocks.monotonic, perf_counter=clocks.monotonic,
            clock_gettime=lambda _: clocks.since_boot(),
        ),
        id(random): _Instead(random, uniform=dice.uniform, random=dice.random),
        id(secrets): _Instead(secrets, token_hex=lambda count: dice.randbytes(count).hex()),
    }  # fmt: skip
    undo: list[Callable[[], None]] = []
    for module in [module for name, module in sys.modules.items() if name.split(".")[0] == PACKAGE]:
        for name, bound in list(vars(module).items()):
            if id(bound) in instead:
                undo.append(lambda module=module, name=name, bound=bound: setattr(module, name, bound))
                setattr(module, name, instead[id(bound)])
            for function in _functions(bound, module.__name__):
                _bind_defaults(function, instead, undo)
    for name, constant, seconds in SLOWER:
        module = sys.modules[f"{PACKAGE}.{name}"]
        undo.append(functools.partial(setattr, module, constant, getattr(module, constant)))
        setattr(module, constant, seconds)
    undo.append(functools.partial(setattr, health, "resident_mib", health.resident_mib))
    health.resident_mib = lambda: None  # it is this process's, and never the same
    undo.append(functools.partial(setattr, os, "statvfs", os.statvfs))
    os.statvfs = lambda _: SimpleNamespace(f_bavail=1 << 20, f_frsize=4096)  # so is the room on this machine's disk
    for name, function in REMEMBERED:
        module = sys.modules[f"{PACKAGE}.{name}"]
        undo.append(functools.partial(setattr, module, function, getattr(module, function)))
        setattr(module, function, _remembered(getattr(module, function)))
    try:
        yield
    finally:
        for step in reversed(undo):
            step()


def _functions(bound: Any, module: str) -> Iterator[FunctionType]:
    """The functions that something of a module consists of."""
    if isinstance(bound, FunctionType) and bound.__module__ == module:
        yield bound
    elif isinstance(bound, type) and bound.__module__ == module:
        for part in list(vars(bound).values()):
            if isinstance(part, FunctionType):
                yield part


def _bind_defaults(function: FunctionType, instead: dict[int, Any], undo: list[Callable[[], None]]) -> None:
    """Default arguments, too."""
    defaults, named = function.__defaults__, function.__kwdefaults__
    if defaults and any(id(value) in instead for value in defaults):
        undo.append(lambda: setattr(function, "__defaults__", defaults))
        function.__defaults__ = tuple(instead.get(id(value), value) for value in defaults)
    if named and any(id(value) in instead for value in named.values()):
        undo.append(lambda: setattr(function, "__kwdefaults__", named))
        function.__kwdefaults__ = {name: instead.get(id(value), value) for name, value in named.items()}
