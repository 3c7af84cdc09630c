"""Non-blocking writer of stderr, and executor for calls that wait for a disk: a reader or a disk may hang."""

import os
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class DaemonThreadExecutor(Executor):
    """Executor that runs calls one after the other in a daemon thread.

    The process can exit while a call hangs, unlike with ``ThreadPoolExecutor``.

    Args:
        name: Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Queue a call of ``fn`` after the earlier calls."""
        future: Future[T] = Future()

        def call() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(fn(*args, **kwargs))
            except BaseException as error:  # noqa: BLE001 - it is raised to the caller that waits
                future.set_exception(error)

        self._calls.put(call)
        if self._thread.ident is None:
            self._thread.start()
        return future

    def _run(self) -> None:
        while True:
            self._calls.get()()


MAX_QUEUED_LINES = 1000
"""Maximum number of queued log lines. Further lines are lost and counted."""
DRAIN_TIMEOUT_S = 1.0
"""Maximum time that the process waits for the reader before it ends [s]."""
STDERR = 2
"""File descriptor of stderr."""


class Stderr:
    """Writer of lines to stderr in a daemon thread, which does not delay the end of the process.

    Attributes:
        lost: Number of lost lines.
    """

    def __init__(self) -> None:
        self._lines: queue.Queue[str] = queue.Queue(MAX_QUEUED_LINES)
        self._thread = threading.Thread(target=self._run, name="stderr", daemon=True)
        self._lock = threading.Lock()
        self.lost = 0

    def put(self, line: str) -> None:
        """Queue a line; callable from any thread, never blocking."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.lost += 1
        with self._lock:
            if self._thread.ident is None:
                self._thread.start()

    def drain(self) -> None:
        """Wait until all lines are written, but no longer than ``DRAIN_TIMEOUT_S``."""
        end_s = time.monotonic() + DRAIN_TIMEOUT_S
        with self._lines.all_tasks_done:
            while self._lines.unfinished_tasks and time.monotonic() < end_s:
                self._lines.all_tasks_done.wait(end_s - time.monotonic())

    def _run(self) -> None:
        while True:
            unwritten = f"{self._lines.get()}\n".encode(errors="replace")
            try:
                while unwritten:  # not by sys.stderr, whose buffer is flushed, and may block, when the process ends
                    unwritten = unwritten[os.write(STDERR, unwritten) :]
            except OSError:  # a full disk costs only this line
                self.lost += 1
            self._lines.task_done()


stderr = Stderr()
"""Writer of this process."""
