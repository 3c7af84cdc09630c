"""Signals of a long-running process: clean shutdown, and acknowledgement of alarms."""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator

import structlog

from bms_estimator.process.stderr_writer import stderr

log = structlog.get_logger(__name__)
_acknowledges: list[Callable[[], object]] = []
"""Functions that SIGUSR1 calls, one for each pack of this process."""


def stop_on_signal(stop: asyncio.Event | None = None) -> asyncio.Event:
    """Return an event, ``stop`` if given, that SIGINT, SIGTERM and SIGHUP set instead of killing the process.

    An ignored SIGHUP stays ignored, as under nohup.
    """
    stop = stop or asyncio.Event()
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    for number in (signal.SIGINT, signal.SIGTERM, *hangup):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


@contextlib.contextmanager
def acknowledge_on_signal(acknowledge: Callable[[], object]) -> Iterator[None]:
    """Call a function on SIGUSR1, in addition to the functions of other packs of this process."""
    _acknowledges.append(acknowledge)
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, _acknowledge_all)
    try:
        yield
    finally:
        _acknowledges.remove(acknowledge)


def _acknowledge_all() -> None:
    for acknowledge in _acknowledges:
        acknowledge()


@contextlib.contextmanager
def exit_on_startup_signals() -> Iterator[None]:
    """Exit with code 0 on SIGTERM or SIGHUP until an event loop handles them. There is no state to save yet.

    An ignored SIGHUP stays ignored, as under nohup.
    """
    unignored = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_DFL]
    previous_handlers = {number: signal.signal(number, _end) for number in unignored}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _end(*_: object) -> None:
    """End the process without an exception, because an exception may be lost in numba's compiler.

    The exit runs in a thread, because the interrupted code may hold the lock of the log.
    """

    def end() -> None:
        log.info("asked to end before samples were taken")
        stderr.drain()
        os._exit(0)

    threading.Thread(target=end, daemon=True).start()
