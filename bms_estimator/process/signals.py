"""How what runs long ends: by a signal, or by the first of their tasks."""

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import structlog

from bms_estimator.process.stderr_writer import stderr

log = structlog.get_logger(__name__)


def stop_on_signal(stop: asyncio.Event | None = None) -> asyncio.Event:
    """An event, ``stop`` where it is given, that SIGINT and SIGTERM set in place of ending the process.

    SIGHUP, too, as when the terminal is closed, unless somebody handles or ignores it.
    """
    stop = stop or asyncio.Event()
    unheard = [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL else []
    for number in (signal.SIGINT, signal.SIGTERM, *unheard):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


@contextlib.contextmanager
def startup_signals(reload: Callable[[], None] | None) -> Iterator[None]:
    """What signals do until an event loop takes them: SIGTERM ends the process with exit code 0, there is nothing to save.

    Args:
        reload: What SIGHUP asks for; None: it ends the process, as when a terminal is closed.
    """
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, _end)}
    if reload:
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, lambda *_: reload())
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(*_: object) -> None:
    """Not by an exception, which the compiler would lose; in a thread, as the log may be held by what was interrupted."""

    def end() -> None:
        log.info("asked to end before samples were taken")
        stderr.drain()
        os._exit(0)

    threading.Thread(target=end, daemon=True).start()


async def until_first_ends(*coroutines: Coroutine[Any, Any, Any]) -> None:
    """Run all until one ends, end the others, raise what one raised."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result
