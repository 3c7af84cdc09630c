"""Simulated threads: each call runs as one event after a random delay."""

import random
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from tests.world.broker import LateError
from tests.world.disk import Disk, PowerCutError
from tests.world.loop import KilledError, ProcessLoop, Timeline

MIN_CALL_S, MAX_CALL_S = 0.0005, 0.05
"""Range of the duration of a call [s]."""
POLL_S = 1.0
"""Time after which a call is tried again if the disk hangs [s]."""


class Threads:
    """Threads of one process.

    Args:
        timeline: Timeline of the world.
        dice: Generator of the random delays of calls.
        loop: Loop of the process.
        disk: Disk that the process's own executors and threads use. They hang while the disk hangs.
        on_end: Called if a call ends the process, with ``KilledError`` or ``PowerCutError``.
    """

    def __init__(
        self,
        timeline: Timeline,
        dice: random.Random,
        loop: ProcessLoop,
        disk: Disk,
        on_end: Callable[[type[BaseException]], None],
    ) -> None:
        self._timeline, self._dice, self.loop, self._disk, self._on_end = timeline, dice, loop, disk, on_end
        loop.threads = _Pool(self)

    def executor(self, *_: Any, thread_name_prefix: str = "", **__: Any) -> Executor:
        """Stand in for ``ThreadPoolExecutor``: return an executor with one thread."""
        return _SingleThread(self, thread_name_prefix)

    def thread(self, *, target: Callable[..., Any], args: tuple[Any, ...] = (), **_: Any) -> Any:
        """Stand in for ``Thread``."""
        thread = _SingleThread(self, "")
        thread.start = lambda: thread.submit(target, *args)  # type: ignore[attr-defined]
        return thread

    def schedule(
        self, call: Callable[[], Any], future: Future[Any], on_done: Callable[[], None], uses_database: bool | None
    ) -> None:
        """Schedule a call.

        Args:
            call: Function to call.
            future: Future of its result.
            on_done: Called after the call.
            uses_database: True for a call that uses a database, False for another use of the disk, None for no use of it.
        """
        delay_s = self._dice.uniform(MIN_CALL_S, MAX_CALL_S)
        self._timeline.after(delay_s, lambda: self._run(call, future, on_done, uses_database))

    def _run(
        self, call: Callable[[], Any], future: Future[Any], on_done: Callable[[], None], uses_database: bool | None
    ) -> None:
        if not self.loop.alive:
            return
        if uses_database is not None and self._disk.hung:
            self._timeline.after(POLL_S, lambda: self._run(call, future, on_done, uses_database))
            return
        try:
            value = self._disk.run_transaction(call, self._timeline.now_s) if uses_database else call()
        except LateError as late:
            error = late.error
            self._timeline.after(late.seconds, lambda: self.loop.alive and _complete(future, None, error))
        except (KilledError, PowerCutError) as end:
            self._on_end(type(end))
            return
        except Exception as error:  # noqa: BLE001 - passed to the caller
            _complete(future, None, error)
        else:
            _complete(future, value, None)
        on_done()


class _Pool(Executor):
    """Executor of ``asyncio.to_thread``, with a thread for each call."""

    def __init__(self, threads: Threads) -> None:
        self._threads = threads

    def submit(self, fn: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._threads.schedule(lambda: fn(*args, **named), future, on_done=lambda: None, uses_database=None)
        return future


class _SingleThread(Executor):
    """Single thread for the disk."""

    def __init__(self, threads: Threads, name: str) -> None:
        self._threads, self._is_database = threads, name == "database"
        self._waiting: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._is_busy = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        if not self._threads.loop.alive:
            raise KilledError
        future: Future[Any] = Future()
        self._waiting.append((lambda: fn(*args, **named), future))
        if not self._is_busy:
            self._start_next()
        return future

    def shutdown(self, *_: Any, **__: Any) -> None:
        pass

    def _start_next(self) -> None:
        self._is_busy = False
        while self._waiting:
            call, future = self._waiting.popleft()
            if future.set_running_or_notify_cancel():
                self._is_busy = True
                self._threads.schedule(call, future, on_done=self._start_next, uses_database=self._is_database)
                return


def _complete(future: Future[Any], value: Any, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(value)
    else:
        future.set_exception(error)
