"""Threads: a call in one takes a while, and happens all at once when the while has passed."""

import random
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from tests.world.broker import LateError
from tests.world.disk import Disk, PowerCutError
from tests.world.loop import KilledError, ProcessLoop, Timeline

MIN_S, MAX_S = 0.0005, 0.05
"""So long a call takes."""
LOOK_S = 1.0
"""So often is looked whether a hung disk answers."""


class Threads:
    """The threads of one process.

    Args:
        timeline: The world's.
        dice: How long calls take.
        loop: Of the process.
        disk: The calls of executors and threads that the process makes for itself are for the disk, and hang with it.
        ended: Told that a call has ended the process, and how.
    """

    def __init__(
        self,
        timeline: Timeline,
        dice: random.Random,
        loop: ProcessLoop,
        disk: Disk,
        ended: Callable[[type[BaseException]], None],
    ) -> None:
        self._timeline, self._dice, self.loop, self._disk, self._ended = timeline, dice, loop, disk, ended
        loop.threads = _Pool(self)

    def executor(self, *_: Any, thread_name_prefix: str = "", **__: Any) -> Executor:
        """In place of ``ThreadPoolExecutor``, with one thread."""
        return _Single(self, thread_name_prefix)

    def thread(self, *, target: Callable[..., Any], args: tuple[Any, ...] = (), **_: Any) -> Any:
        """In place of ``Thread``."""
        single = _Single(self, "")
        single.start = lambda: single.submit(target, *args)  # type: ignore[attr-defined]
        return single

    def later(
        self, call: Callable[[], Any], future: Future[Any], then: Callable[[], None], database: bool | None
    ) -> None:
        """Have ``call`` happen; ``database``: it is one, None: it has nothing to do with the disk."""
        delay_s = self._dice.uniform(MIN_S, MAX_S)
        self._timeline.after(delay_s, lambda: self._work(call, future, then, database))

    def _work(
        self, call: Callable[[], Any], future: Future[Any], then: Callable[[], None], database: bool | None
    ) -> None:
        if not self.loop.alive:
            return
        if database is not None and self._disk.hung:
            self._timeline.after(LOOK_S, lambda: self._work(call, future, then, database))
            return
        try:
            value = self._disk.transaction(call, self._timeline.now_s) if database else call()
        except LateError as late:
            error = late.error
            self._timeline.after(late.seconds, lambda: self.loop.alive and _end(future, None, error))
        except (KilledError, PowerCutError) as end:
            self._ended(type(end))
            return
        except Exception as error:  # noqa: BLE001 - whatever it is, who waits gets it
            _end(future, None, error)
        else:
            _end(future, value, None)
        then()


class _Pool(Executor):
    """As many threads as there are calls."""

    def __init__(self, threads: Threads) -> None:
        self._threads = threads

    def submit(self, fn: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._threads.later(lambda: fn(*args, **named), future, lambda: None, None)
        return future


class _Single(Executor):
    """One thread, for the disk."""

    def __init__(self, threads: Threads, name: str) -> None:
        self._threads, self._is_database = threads, name == "database"
        self._waiting: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._works = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **named: Any) -> Future[Any]:
        if not self._threads.loop.alive:
            raise KilledError
        future: Future[Any] = Future()
        self._waiting.append((lambda: fn(*args, **named), future))
        if not self._works:
            self._next()
        return future

    def shutdown(self, *_: Any, **__: Any) -> None:
        pass

    def _next(self) -> None:
        self._works = False
        while self._waiting:
            call, future = self._waiting.popleft()
            if future.set_running_or_notify_cancel():
                self._works = True
                self._threads.later(call, future, self._next, self._is_database)
                return


def _end(future: Future[Any], value: Any, error: BaseException | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(value)
    else:
        future.set_exception(error)
