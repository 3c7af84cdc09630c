"""Runtime of a long-running process: log on stderr, signals, delays before retries, and ending of tasks by cancellation."""

import asyncio
import contextlib
import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Coroutine, Iterator, MutableMapping, MutableSequence
from typing import Any, TypeVar, get_args

import structlog
from structlog.processors import ExceptionRenderer
from structlog.tracebacks import ExceptionDictTransformer

from bms_estimator.process.stderr_writer import stderr
from bms_estimator.settings.pack import LogLevel

Result = TypeVar("Result")
"""Result of a coroutine."""
LEVELS: tuple[LogLevel, ...] = get_args(LogLevel)
_levels: dict[str, LogLevel] = {}
"""Log levels by pack."""
_exception_as_dicts = ExceptionRenderer(ExceptionDictTransformer(show_locals=False))
"""Processor that converts an exception to dicts for JSON."""


def configure_logs(lines: MutableSequence[str] | None = None) -> None:
    """Configure structlog for this process.

    Args:
        lines: List that receives the lines in place of stderr, for a live view that uses the terminal itself.
    """
    readable = lines is not None or (sys.stderr.isatty() and "JOURNAL_STREAM" not in os.environ)
    to_stderr = lines is None
    # tracebacks without local variables, which may contain a password
    renderers: list[Any] = (
        [
            structlog.dev.ConsoleRenderer(
                30 if to_stderr else 0,  # width of the event
                colors=to_stderr,
                pad_level=to_stderr,
                exception_formatter=structlog.dev.plain_traceback,
            )
        ]
        if readable
        else [_exception_as_dicts, structlog.processors.JSONRenderer()]
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            _drop_below_level,
            structlog.processors.TimeStamper(fmt="iso" if to_stderr else "%H:%M:%SZ", utc=True),
            *renderers,
        ],
        logger_factory=lambda *_: _LineLogger(stderr.put if lines is None else lines.append),
    )


@contextlib.contextmanager
def flush_logs() -> Iterator[None]:
    """Write the log before the command line prints an error."""
    try:
        yield
    finally:
        stderr.drain()


def set_level(pack: str, level: LogLevel) -> None:
    """Set a pack's minimum log level; a process with several packs uses the lowest of them."""
    _levels[pack] = level


def _drop_below_level(_: object, __: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Drop lines below the level.

    Raises:
        structlog.DropEvent: The line is below the level.
    """
    min_level = min((LEVELS.index(level) for level in _levels.values()), default=0)
    if line["level"] in LEVELS and LEVELS.index(line["level"]) < min_level:
        raise structlog.DropEvent
    return line


class _LineLogger:
    """Logger of structlog that passes lines to a function."""

    def __init__(self, write_line: Callable[[str], object]) -> None:
        self._write_line = write_line

    def msg(self, message: str) -> None:
        self._write_line(message)

    debug = info = warning = error = critical = exception = msg


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
    previous_handlers = {number: signal.signal(number, _exit_process) for number in unignored}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _exit_process(*_: object) -> None:
    """End the process without an exception, because an exception may be lost in numba's compiler.

    The exit runs in a thread, because the interrupted code may hold the lock of the log.
    """

    def exit_process() -> None:
        log.info("asked to end before samples were taken")
        stderr.drain()
        os._exit(0)

    threading.Thread(target=exit_process, daemon=True).start()


FIRST_DELAY_S = 2.0
"""First delay of a ``Backoff``; it doubles with each attempt [s]."""
MAX_DELAY_S = 30.0
"""Maximum delay of a ``Backoff`` [s]. A local broker is usually unavailable for a short time only."""


class Backoff:
    """Increasing delays with jitter, so that not all clients of a broker reconnect at the same time.

    Args:
        first_s: First delay [s].
        max_s: Maximum delay [s].
    """

    def __init__(self, first_s: float = FIRST_DELAY_S, max_s: float = MAX_DELAY_S) -> None:
        self._first_s = self._next_s = first_s
        self._max_s = max_s

    def next_s(self) -> float:
        """Return the next delay [s]."""
        delay_s = self._next_s
        self._next_s = min(2.0 * delay_s, self._max_s)
        return delay_s * random.uniform(0.5, 1.0)

    def reset(self) -> None:
        """Restart with the first delay after a success."""
        self._next_s = self._first_s


CANCEL_INTERVAL_S = 0.1
"""Interval at which a task that ignores cancellation is cancelled again [s]."""


async def end_tasks(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks repeatedly until all have ended. They must not contain work that has to be finished.

    Some libraries, and wait_for of Python 3.11, may swallow a cancellation.
    A cancellation of the caller takes effect afterwards, because unfinished tasks would run on without an owner.
    """
    cancellation: asyncio.CancelledError | None = None
    while unfinished := {task for task in tasks if not task.done()}:
        for task in unfinished:
            task.cancel()
        try:
            await asyncio.wait(unfinished, timeout=CANCEL_INTERVAL_S)
        except asyncio.CancelledError as error:
            cancellation = error
    if cancellation:
        raise cancellation


async def finish(task: asyncio.Task[None], timeout_s: float) -> None:
    """Wait until a task has ended, and cancel it after ``timeout_s``. Raise its exception."""
    done, _ = await asyncio.wait([task], timeout=timeout_s)
    if not done:
        task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def result_before(stop: asyncio.Event, coroutine: Coroutine[Any, Any, Result]) -> Result | None:
    """Return the result of a coroutine; None if ``stop`` is set before, which cancels it."""
    task = asyncio.ensure_future(coroutine)
    try:
        # a stop cancels only ``asyncio.wait``; therefore the task is done only if it has a result or an error
        await until_first_ends(asyncio.wait([task]), stop.wait())
    finally:
        await end_tasks(task)
    return None if task.cancelled() else task.result()


async def until_first_ends(*coroutines: Coroutine[Any, Any, Any]) -> None:
    """Run coroutines until one ends, cancel the others, and raise the first exception of any of them."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in coroutines]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await end_tasks(*tasks)
    for task in tasks:
        if not task.cancelled() and (error := task.exception()):
            raise error
