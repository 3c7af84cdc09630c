"""Replacement of the package's clocks and random numbers by those of the world.

The package contains no code for this. While the world lasts, all references of its modules to the clocks and random functions of
the standard library are replaced, also those in default arguments of functions.
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
from bms_estimator.process.boot_timestamp import BootTimestamp, boot_timestamp
from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.telemetry import health
from tests.world.disk import Disk
from tests.world.threads import Threads

PACKAGE = "bms_estimator"


class Clocks:
    """Clocks of the world: a wall clock that may be stepped, two steady clocks, and the boot id.

    Attributes:
        wall_offset_s: Wall clock minus time of the world [s].
        synchronized: True if the wall clock counts as synchronized.
        boot: Boot id.
        boot_s: Time of the world at the last boot [s].
        suspended_s: Time since the boot that the monotonic clock does not count [s].
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self.wall_offset_s = 1.7e9  # the world begins in November 2023
        self.synchronized = True
        self.boot = "first"
        self.boot_s = 0.0
        self.suspended_s = 0.0

    def wall(self) -> float:
        return self._now() + self.wall_offset_s

    def since_boot(self) -> float:
        return self._now() - self.boot_s

    def monotonic(self) -> float:
        return self.since_boot() - self.suspended_s

    def boot_timestamp(self) -> BootTimestamp:
        return BootTimestamp(self.wall(), self.synchronized, self.since_boot(), self.boot)


class _PatchedModule:
    """Module of the standard library with some replaced functions."""

    def __init__(self, module: ModuleType, **functions: Any) -> None:
        self._module = module
        self.__dict__.update(functions)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


LONGER_INTERVALS = (
    ("service.live_loop", "LAG_INTERVAL_S", 2.0),
    ("sources.serial.serial_source", "SEND_INTERVAL_S", 0.5),
)
"""Module, name and new value [s] of poll intervals. With the real ones, most of the simulation's time would be polling."""
CACHED_FUNCTIONS = (("estimator.settings_records", "decay_table"),)
"""Module and name of pure, slow functions. Their results are cached, because each start of the service calls them again."""


@functools.cache
def _cached(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a cached version of a function, which all worlds of this process share."""
    return functools.cache(function)


@contextlib.contextmanager
def replace_in_package(
    clocks: Clocks, dice: random.Random, threads: Callable[[], Threads], disk: Disk
) -> Iterator[None]:
    """Replace clocks, random numbers, threads and disk of the package."""
    # The keys are ids, because not every value of a module is hashable.
    replacements: dict[int, Any] = {
        id(time.time): clocks.wall,
        id(time.monotonic): clocks.monotonic,
        id(time.perf_counter): clocks.monotonic,
        id(clock.since_boot): clocks.since_boot,
        id(boot_timestamp): clocks.boot_timestamp,
        id(random.uniform): dice.uniform,
        id(random.random): dice.random,
        id(ThreadPoolExecutor): lambda *args, **named: threads().executor(*args, **named),
        id(DaemonThreadExecutor): lambda name: threads().executor(thread_name_prefix=name),
        id(Thread): lambda **named: threads().thread(**named),
        id(sqlite3): _PatchedModule(sqlite3, connect=disk.connect),
        id(secrets.token_hex): lambda count: dice.randbytes(count).hex(),
        id(time): _PatchedModule(
            time, time=clocks.wall, monotonic=clocks.monotonic, perf_counter=clocks.monotonic,
            clock_gettime=lambda _: clocks.since_boot(),
        ),
        id(random): _PatchedModule(random, uniform=dice.uniform, random=dice.random),
        id(secrets): _PatchedModule(secrets, token_hex=lambda count: dice.randbytes(count).hex()),
    }  # fmt: skip
    undo: list[Callable[[], None]] = []
    for module in [module for name, module in sys.modules.items() if name.split(".")[0] == PACKAGE]:
        for name, value in list(vars(module).items()):
            if id(value) in replacements:
                undo.append(lambda module=module, name=name, value=value: setattr(module, name, value))
                setattr(module, name, replacements[id(value)])
            for function in _functions(value, module.__name__):
                _bind_defaults(function, replacements, undo)
    for name, constant, seconds in LONGER_INTERVALS:
        module = sys.modules[f"{PACKAGE}.{name}"]
        undo.append(functools.partial(setattr, module, constant, getattr(module, constant)))
        setattr(module, constant, seconds)
    undo.append(functools.partial(setattr, health, "resident_mib", health.resident_mib))
    health.resident_mib = lambda: None  # differs between runs
    undo.append(functools.partial(setattr, os, "statvfs", os.statvfs))
    os.statvfs = lambda _: SimpleNamespace(f_bavail=1 << 20, f_frsize=4096)  # differs between machines
    for name, function in CACHED_FUNCTIONS:
        module = sys.modules[f"{PACKAGE}.{name}"]
        undo.append(functools.partial(setattr, module, function, getattr(module, function)))
        setattr(module, function, _cached(getattr(module, function)))
    try:
        yield
    finally:
        for step in reversed(undo):
            step()


def _functions(value: Any, module: str) -> Iterator[FunctionType]:
    """Yield ``value`` if it is a function of ``module``, or its methods if it is a class of ``module``."""
    if isinstance(value, FunctionType) and value.__module__ == module:
        yield value
    elif isinstance(value, type) and value.__module__ == module:
        for member in list(vars(value).values()):
            if isinstance(member, FunctionType):
                yield member


def _bind_defaults(function: FunctionType, replacements: dict[int, Any], undo: list[Callable[[], None]]) -> None:
    """Replace default arguments of a function. Append to ``undo`` how to restore them."""
    defaults, named = function.__defaults__, function.__kwdefaults__
    if defaults and any(id(value) in replacements for value in defaults):
        undo.append(lambda: setattr(function, "__defaults__", defaults))
        function.__defaults__ = tuple(replacements.get(id(value), value) for value in defaults)
    if named and any(id(value) in replacements for value in named.values()):
        undo.append(lambda: setattr(function, "__kwdefaults__", named))
        function.__kwdefaults__ = {name: replacements.get(id(value), value) for name, value in named.items()}
