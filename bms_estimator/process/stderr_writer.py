"""Stderr that nothing waits for: whoever reads it, or the disk behind it, may hang."""

import os
import queue
import threading
import time

WAITING_LINES = 1000
"""Maximum number of log lines waiting for the reader; further lines are lost and counted."""
END_S = 1.0
"""Time that the process waits at its end for the reader [s]."""
STDERR = 2


class Stderr:
    """Lines for stderr, written by a thread that the end of the process does not wait for.

    Attributes:
        lost: Number of lost lines.
    """

    def __init__(self) -> None:
        self._lines: queue.Queue[str] = queue.Queue(WAITING_LINES)
        self._thread = threading.Thread(target=self._run, name="stderr", daemon=True)
        self._lock = threading.Lock()
        self.lost = 0

    def take(self, line: str) -> None:
        """Have a line written; from any thread, at once."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.lost += 1
        with self._lock:
            if self._thread.ident is None:
                self._thread.start()

    def drain(self) -> None:
        """Wait until all is written, but no longer than ``END_S``."""
        end_s = time.monotonic() + END_S
        with self._lines.all_tasks_done:
            while self._lines.unfinished_tasks and time.monotonic() < end_s:
                self._lines.all_tasks_done.wait(end_s - time.monotonic())

    def _run(self) -> None:
        while True:
            rest = f"{self._lines.get()}\n".encode(errors="replace")
            try:
                while rest:  # not by sys.stderr: its buffer would wait once more, as the process ends
                    rest = rest[os.write(STDERR, rest) :]
            except OSError:  # a full disk costs only this line
                self.lost += 1
            self._lines.task_done()


stderr = Stderr()
"""Writer of this process."""
