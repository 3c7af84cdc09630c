"""Recording beside the estimate: the reader of the source never waits for the disk."""

import errno
import queue
import time
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Self

import structlog

from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter

SYNC_S = 5.0
"""The disk has all but the last seconds, even when the power fails [s]."""
WAITING_READS = 1 << 16
"""Maximum number of chunks waiting for the disk: a minute at a thousand samples a second."""

END_S = 5.0
"""Time that the recorder waits at its end for the disk to accept waiting chunks [s]."""

log = structlog.get_logger(__name__)


class CaptureRecorder:
    """A tap that writes a capture in a thread of its own.

    A context manager that writes the remaining chunks at its end.

    A disk that fails, or stays behind for too long, ends the recording and nothing else. The file contains complete
    records only.
    One that hangs does not hold up the end, either.

    Args:
        path: A file that does not exist yet.
        header: Header of the capture.
        waiting_reads: Maximum number of chunks waiting for the disk.
        sync_s: Interval at which data are synced to the disk [s].

    Attributes:
        bytes: Number of recorded bytes.
        ended: Done when the recording has ended; holds the ``OSError`` if one has ended it.

    Raises:
        UserError: The file exists or cannot be made.
    """

    def __init__(
        self, path: Path, header: CaptureHeader, *, waiting_reads: int = WAITING_READS, sync_s: float = SYNC_S
    ) -> None:
        self._writer = CaptureWriter(path, header)
        self._path, self._waiting_reads, self._sync_s = path, waiting_reads, sync_s
        self._waiting: queue.SimpleQueue[tuple[float, bytes] | OSError | None] = queue.SimpleQueue()
        self._behind = False
        self._reads = self._written = self.bytes = 0
        self.ended: Future[None] = DiskThread("recording").submit(self._run)

    @property
    def missed_reads(self) -> int:
        """Reads that are not in the file, once the recording has ended."""
        return self._reads - self._written if self.ended.done() else 0

    @property
    def fault(self) -> str:
        """Why the file has not all that was taken; empty when it has. For after the end."""
        if not self.ended.done():
            return f"the disk has not answered for {END_S:g} s"
        error = self.ended.exception()
        return "" if error is None else getattr(error, "strerror", None) or str(error)

    def write(self, arrival_s: float, data: bytes) -> None:
        """Take one read of the line; after the end of the recording it is only counted."""
        self._reads += 1
        if self._behind or self.ended.done():
            return
        if self._waiting.qsize() >= self._waiting_reads:
            self._behind = True
            self._waiting.put(OSError(errno.ENOBUFS, f"the disk stays behind, {self._waiting_reads:,} reads wait"))
            return
        self.bytes += len(data)
        self._waiting.put((arrival_s, data))

    def __enter__(self) -> Self:
        """Return the recorder."""
        return self

    def __exit__(self, *_: object) -> None:
        """Have the disk take all that waits, and close; one that takes nothing for ``END_S`` is left alone."""
        self._waiting.put(None)
        before = -1
        while not self.ended.done() and self._written > before:
            before = self._written
            wait([self.ended], END_S)
        if not self.ended.done():
            log.warning("recording not ended", file=str(self._path), reason=self.fault)

    def _run(self) -> None:
        """Write until stopped; the writer's close waits for the disk."""
        try:
            with self._writer:
                self._write_on()
        except OSError as error:
            log.warning("recording ended", file=str(self._path), reason=error.strerror)
            raise

    def _write_on(self) -> None:
        sync_s = time.monotonic() + self._sync_s
        while True:
            if (now_s := time.monotonic()) >= sync_s:
                self._writer.sync()
                sync_s = now_s + self._sync_s
            try:
                read = self._waiting.get(timeout=sync_s - now_s)
            except queue.Empty:
                continue
            if read is None:
                return
            if isinstance(read, OSError):
                raise read
            self._writer.write(*read)
            self._written += 1
