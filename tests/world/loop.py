"""Virtual time: one heap of events for the whole world, and an asyncio loop for each process.

Events run one after another. When no handle is ready, the time advances to the next event without waiting.
"""

import asyncio
import contextlib
import contextvars
import heapq
import random
import sys
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Executor
from typing import Any

MAX_CLOSE_ATTEMPTS = 20
"""Maximum number of attempts to close a coroutine, each of which fails if the coroutine awaits."""
CLEAN_UP_TASKS = 64
"""Number of new tasks after which finished ones are removed from the list of tasks."""


class KilledError(BaseException):
    """End of the calling process by a kill."""


class Timeline:
    """Events of the world and timers of its processes, in order of time.

    Args:
        dice: Random generator that decides the order of simultaneous events.
    """

    def __init__(self, dice: random.Random) -> None:
        self.now_s = 0.0
        self._dice, self._count = dice, 0
        self._events: list[tuple[float, float, int, Callable[[], None]]] = []

    def __len__(self) -> int:
        return len(self._events)

    def at(self, when_s: float, event: Callable[[], None]) -> None:
        """Schedule an event; at once if ``when_s`` has passed."""
        self._count += 1
        heapq.heappush(self._events, (max(when_s, self.now_s), self._dice.random(), self._count, event))

    def after(self, delay_s: float, event: Callable[[], None]) -> None:
        """Schedule an event ``delay_s`` from now."""
        self.at(self.now_s + delay_s, event)

    def step(self) -> None:
        """Advance to the next event and run it."""
        self.now_s, _, _, event = heapq.heappop(self._events)
        event()


class Handle(asyncio.TimerHandle):
    """Scheduled call. asyncio's own handle is slower, because it checks the debug mode three times.

    Args:
        callback: Function to call.
        args: Arguments of the call.
        context: Context of the call; None: a copy of the present one.
    """

    __slots__ = ()

    def __init__(self, callback: Any, args: tuple[Any, ...], context: contextvars.Context | None) -> None:
        self._callback, self._args, self._cancelled = callback, args, False
        self._context = contextvars.copy_context() if context is None else context

    def cancel(self) -> None:
        self._cancelled = True
        self._callback = self._args = None


class ProcessLoop(asyncio.AbstractEventLoop):
    """Event loop of one process. A kill ends it between two handles; none of its code runs afterwards.

    Args:
        timeline: Timeline of the world.
    """

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self._ready: deque[Handle] = deque()
        self._readers: dict[int, Handle] = {}
        self._tasks: list[asyncio.Task[Any]] = []
        self._task_count = 0
        self.alive = True
        self.frozen_until_s = self._frozen_s = 0.0
        self.handles = 0
        """Number of handles that have run."""
        self.uncaught_exceptions: list[str] = []
        """Descriptions of the exceptions that reached the loop."""
        self.threads: Executor = Executor()
        """Default executor."""

    # interface of asyncio

    def time(self) -> float:
        return self._timeline.now_s

    def call_soon(self, callback: Any, *args: Any, context: Any = None) -> Handle:
        handle = Handle(callback, args, context)
        if self.alive:
            self._ready.append(handle)
        return handle

    call_soon_threadsafe = call_soon

    def call_at(self, when: float, callback: Any, *args: Any, context: Any = None) -> Handle:
        handle = Handle(callback, args, context)
        if self.alive:
            self._timeline.at(max(when, self.frozen_until_s), lambda: self._make_ready(handle))
        return handle

    def call_later(self, delay: float, callback: Any, *args: Any, context: Any = None) -> Handle:
        return self.call_at(self.time() + delay, callback, *args, context=context)

    def create_future(self) -> asyncio.Future[Any]:
        if not self.alive:
            raise KilledError
        return asyncio.Future(loop=self)

    def create_task(self, coro: Coroutine[Any, Any, Any], *, name: str | None = None, context: Any = None) -> Any:
        if not self.alive:
            coro.close()
            raise KilledError
        self._task_count += 1
        task = asyncio.Task(coro, loop=self, name=name or f"task {self._task_count}", context=context)
        if self._task_count % CLEAN_UP_TASKS == 0:
            self._tasks = [task for task in self._tasks if not task.done()]
        self._tasks.append(task)
        return task

    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> asyncio.Future[Any]:
        if not self.alive:
            raise KilledError
        return asyncio.wrap_future((executor or self.threads).submit(func, *args), loop=self)

    def add_reader(self, fd: int, callback: Any, *args: Any) -> None:
        self._readers[fd] = Handle(callback, args, None)

    def remove_reader(self, fd: int) -> bool:
        reader = self._readers.pop(fd, None)
        if reader is not None:
            reader.cancel()
        return reader is not None

    def add_signal_handler(self, *_: Any) -> None:
        pass

    def remove_signal_handler(self, *_: Any) -> bool:
        return True

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return self.alive

    def is_closed(self) -> bool:
        return not self.alive

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        if self.alive:
            self.uncaught_exceptions.append(f"{context.get('message')}: {context.get('exception')!r}")

    async def shutdown_asyncgens(self) -> None:
        pass

    # interface for the world

    @property
    def busy(self) -> bool:
        """True if a handle is ready."""
        return bool(self._ready) and self.alive and self._timeline.now_s >= self.frozen_until_s

    @property
    def ran_until_s(self) -> float:
        """Time at which the process last ran: now, or the beginning of a freeze [s]."""
        return self._frozen_s if self._timeline.now_s < self.frozen_until_s else self._timeline.now_s

    @property
    def ready_count(self) -> int:
        """Number of ready handles."""
        return len(self._ready)

    def notify_reader(self, fd: int) -> None:
        """Schedule the reader of a descriptor."""
        reader = self._readers.get(fd)
        if reader is not None and self.alive:
            self._ready.append(reader)

    def step(self) -> None:
        """Run one handle."""
        handle = self._ready.popleft()
        if handle._cancelled:
            return
        self.handles += 1
        asyncio._set_running_loop(self)
        try:
            handle._context.run(handle._callback, *handle._args)
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:  # noqa: BLE001 - as asyncio's own loop does
            self.call_exception_handler({"message": f"Exception in callback {handle._callback}", "exception": error})
        finally:
            asyncio._set_running_loop(None)

    def freeze(self, until_s: float) -> None:
        """Freeze the process until ``until_s``."""
        self._frozen_s, self.frozen_until_s = self.ran_until_s, until_s
        self._timeline.at(until_s, lambda: None)  # so that the time does not skip the end of the freeze

    def kill(self) -> None:
        """Kill the process: release its resources; none of its code has any further effect."""
        if not self.alive:
            return
        self.alive = False
        self._ready.clear()
        self._readers.clear()
        # Python would report coroutines that cannot be closed.
        original_hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
        try:
            with self._running():
                for task in self._tasks:
                    task._log_destroy_pending = False
                    if not task.done():
                        _close(task.get_coro())
                self._tasks.clear()
                self._ready.clear()
        finally:
            sys.unraisablehook = original_hook

    def start(self, main: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Start the main task."""
        with self._running():
            return self.create_task(main, name="main")

    def _make_ready(self, handle: Handle) -> None:
        if self.alive and not handle._cancelled:
            self._ready.append(handle)

    @contextlib.contextmanager
    def _running(self) -> Iterator[None]:
        asyncio._set_running_loop(self)
        try:
            yield
        finally:
            asyncio._set_running_loop(None)


def _close(coroutine: Any) -> None:
    """Close a coroutine, even if it awaits in its own cleanup."""
    for _ in range(MAX_CLOSE_ATTEMPTS):
        try:
            coroutine.close()
        except RuntimeError:  # the coroutine awaits while it is closed
            continue
        except BaseException:  # noqa: BLE001 - the process has ended
            pass
        return
