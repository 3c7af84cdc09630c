"""Serial port that is opened with pyserial, read by the event loop, and reopened when it is lost, for any protocol."""

import asyncio
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.process.backoff import FIRST_RETRY_S, MAX_RETRY_S
from bms_estimator.sources.serial.port_list import NoPortError, PortBusyError
from bms_estimator.sources.source import Chunk

if TYPE_CHECKING:
    import serial

READ_BYTES = 1 << 16
"""Maximum size of one read [bytes]."""

log = structlog.get_logger(__name__)


class SerialPort:
    """Serial port that queues received bytes with their arrival times.

    An arrival time is the wall clock at start plus the time since then on a monotonic clock that includes suspend.
    Arrival times therefore never step.

    Args:
        find_and_open: Finds and opens the port; returns its path and the port.
        report: Called with the reason why the port is not open.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: Delay before a missing or lost port is retried [s].

    Attributes:
        openings: Number of times that the port was opened.
        lost: Event that is set when the port fails. The owner may also set it to have the port closed.
    """

    def __init__(
        self,
        find_and_open: Callable[[], tuple[str, "serial.Serial"]],
        *,
        report: Callable[[str], None],
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = since_boot,
        first_retry_s: float = FIRST_RETRY_S,
    ) -> None:
        self._find_and_open, self._report = find_and_open, report
        self._monotonic, self._wall_offset_s = monotonic, wall() - monotonic()
        self._first_retry_s, self._retry_s = first_retry_s, 0.0
        self._chunks: asyncio.Queue[Chunk | None] = asyncio.Queue()
        self._port: serial.Serial | None = None
        self.openings = 0
        self.lost = asyncio.Event()

    @property
    def now_s(self) -> float:
        """Present time on the clock of the arrival times [s since 1970]."""
        return self._wall_offset_s + self._monotonic()

    @property
    def is_open(self) -> bool:
        """True if bytes can be sent."""
        return self._port is not None

    @property
    def queued_chunks(self) -> int:
        """Number of chunks waiting to be decoded."""
        return self._chunks.qsize()

    async def open(self) -> str:
        """Open the port, with retries until it succeeds, and return its path.

        Each attempt waits longer than the previous one, until ``reset_backoff`` is called.
        """
        while True:
            await asyncio.sleep(self._retry_s)
            self._retry_s = min(max(2.0 * self._retry_s, self._first_retry_s), MAX_RETRY_S)
            try:
                path, self._port = self._find_and_open()
            except PortBusyError as error:
                # the error's text needs a slow search through /proc, which must not block other packs
                reason = await asyncio.to_thread(str, error)
            except (NoPortError, OSError) as error:
                reason = str(error)
            else:
                break
            self._report(f"waiting for {reason}")
        self.openings += 1
        self.lost.clear()
        self._chunks.put_nowait((self.now_s, b""))  # marks the opening of the port
        asyncio.get_running_loop().add_reader(self._port.fileno(), self._read, self._port.fileno())
        return path

    def reset_backoff(self) -> None:
        """Reset the delay between attempts to open the port to its minimum."""
        self._retry_s = self._first_retry_s

    def close(self) -> None:
        """Close the port, which may be reopened."""
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            self._port.close()
            self._port = None

    def finish(self) -> None:
        """Make ``read`` return None after the queued chunks."""
        self._chunks.put_nowait(None)

    async def read(self) -> Chunk | None:
        """Return the next chunk: an empty one after each opening of the port, and None at the end."""
        return await self._chunks.get()

    def send(self, data: bytes) -> None:
        """Write bytes. They are lost if the port is closed or fails."""
        if self._port is None or not data:
            return
        try:
            os.write(self._port.fileno(), data)
        except OSError as error:
            log.warning("not sent", reason=str(error))

    def _read(self, descriptor: int) -> None:
        """Read from a descriptor that has bytes or has failed."""
        arrival_s = self.now_s
        try:
            data = os.read(descriptor, READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            asyncio.get_running_loop().remove_reader(descriptor)
            self.lost.set()
            return
        self._chunks.put_nowait((arrival_s, data))
