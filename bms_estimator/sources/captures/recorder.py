"""Recorder of a source's chunks. Its own thread writes them, so that the source never waits for the disk."""

import asyncio
import contextlib
import errno
import queue
import time
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Self

import structlog

from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter

SYNC_S = 5.0
"""Interval between two syncs to disk [s]. A power failure loses at most the data since the last sync."""
MAX_QUEUED_CHUNKS = 1 << 16
"""Maximum number of chunks that wait for the disk. At 1000 chunks per second the queue fills in about a minute."""
SHUTDOWN_TIMEOUT_S = 5.0
"""Timeout at shutdown [s]. The recorder waits while the disk completes at least one chunk within this time."""

log = structlog.get_logger(__name__)


class CaptureRecorder:
    """Tap that writes a capture in its own thread; a context manager that writes the queued chunks on exit.

    A disk that fails or is too slow ends the recording, but not the service. The file then contains complete records
    only. A hung disk does not delay the exit beyond ``SHUTDOWN_TIMEOUT_S``.

    Args:
        path: A file that does not exist yet.
        header: Header of the capture.
        max_queued_chunks: Maximum number of chunks waiting for the disk.
        sync_s: Interval at which data are synced to the disk [s].

    Attributes:
        bytes: Number of received bytes, queued ones included.
        ended: Future that is done when the recording has ended, with the ``OSError`` if one ended it.

    Raises:
        UserError: The file exists or cannot be created.
    """

    def __init__(
        self, path: Path, header: CaptureHeader, *, max_queued_chunks: int = MAX_QUEUED_CHUNKS, sync_s: float = SYNC_S
    ) -> None:
        self._writer = CaptureWriter(path, header)
        self._path, self._max_queued_chunks, self._sync_s = path, max_queued_chunks, sync_s
        self._queue: queue.SimpleQueue[tuple[float, bytes] | OSError | None] = queue.SimpleQueue()
        self._overflowed = False
        self._received_chunks = self._written_chunks = self.bytes = 0
        self.ended: Future[None] = DaemonThreadExecutor("recording").submit(self._record)

    @property
    def missed_reads(self) -> int:
        """Number of chunks missing in the file; 0 until the recording has ended."""
        return self._received_chunks - self._written_chunks if self.ended.done() else 0

    @property
    def fault(self) -> str:
        """Reason why chunks are missing in the file; empty if none are. Valid after the exit."""
        if not self.ended.done():
            return f"the disk has not answered for {SHUTDOWN_TIMEOUT_S:g} s"
        error = self.ended.exception()
        return "" if error is None else getattr(error, "strerror", None) or str(error)

    def write(self, arrival_s: float, data: bytes) -> None:
        """Queue one chunk. After the end of the recording it is only counted."""
        self._received_chunks += 1
        if self._overflowed or self.ended.done():
            return
        if self._queue.qsize() >= self._max_queued_chunks:
            self._overflowed = True
            self._queue.put(
                OSError(errno.ENOBUFS, f"the disk is too slow, {self._max_queued_chunks:,} chunks are queued")
            )
            return
        self.bytes += len(data)
        self._queue.put((arrival_s, data))

    async def wait_for_end(self) -> None:
        """Wait until the recording has ended. An error of the disk is not raised: see ``fault``."""
        with contextlib.suppress(OSError):
            await asyncio.wrap_future(self.ended)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Wait until the queued chunks are written, unless the disk writes none for ``SHUTDOWN_TIMEOUT_S``."""
        self._queue.put(None)
        written_before = -1
        while not self.ended.done() and self._written_chunks > written_before:
            written_before = self._written_chunks
            wait([self.ended], SHUTDOWN_TIMEOUT_S)
        if not self.ended.done():
            log.warning("recording not ended", file=str(self._path), reason=self.fault)

    def _record(self) -> None:
        """Write chunks until stopped. Closing the writer waits for the disk."""
        try:
            with self._writer:
                self._write_chunks()
        except OSError as error:
            log.warning("recording ended", file=str(self._path), reason=error.strerror)
            raise

    def _write_chunks(self) -> None:
        """Write queued chunks until None is queued.

        Raises:
            OSError: The disk failed, or the queue overflowed.
        """
        sync_due_s = time.monotonic() + self._sync_s
        while True:
            if (now_s := time.monotonic()) >= sync_due_s:
                self._writer.sync()
                sync_due_s = now_s + self._sync_s
            try:
                item = self._queue.get(timeout=sync_due_s - now_s)
            except queue.Empty:
                continue
            if item is None:
                return
            if isinstance(item, OSError):
                raise item
            self._writer.write(*item)
            self._written_chunks += 1
