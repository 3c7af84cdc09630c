"""A serial line: opened with pyserial, read when its descriptor has bytes, opened again when it is lost.

Independent of protocols.
"""

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


log = structlog.get_logger(__name__)


class SerialPort:
    """A port with its received and sent bytes.

    Arrival times are the wall clock at start plus a clock that never steps since; it continues during suspend.

    Args:
        open_next: Opens the port: returns its path, and the port.
        say: Called with the reason why the port is not open.
        wall: Wall clock [s since 1970].
        monotonic: Monotonic clock [s].
        first_retry_s: Delay before a missing or lost port is retried [s].

    Attributes:
        openings: Number of times that it was opened.
        lost: Set when the port has died, or to request its end.
    """

    def __init__(
        self,
        open_next: Callable[[], tuple[str, "serial.Serial"]],
        *,
        say: Callable[[str], None],
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = since_boot,
        first_retry_s: float = FIRST_RETRY_S,
    ) -> None:
        self._open_next, self._say = open_next, say
        self._monotonic, self._epoch_s = monotonic, wall() - monotonic()
        self._first_retry_s, self._retry_s = first_retry_s, 0.0
        self._reads: asyncio.Queue[Chunk | None] = asyncio.Queue()
        self._port: serial.Serial | None = None
        self.openings = 0
        self.lost = asyncio.Event()

    @property
    def now_s(self) -> float:
        """On the clock of the arrivals [s since 1970]."""
        return self._epoch_s + self._monotonic()

    @property
    def is_open(self) -> bool:
        """True if bytes can be sent."""
        return self._port is not None

    @property
    def waiting(self) -> int:
        """Number of chunks waiting to be decoded."""
        return self._reads.qsize()

    async def open(self) -> str:
        """Path of the port as soon as it can be opened; each attempt waits longer until one was ``confirm``."""
        while True:
            await asyncio.sleep(self._retry_s)
            self._retry_s = min(max(2.0 * self._retry_s, self._first_retry_s), MAX_RETRY_S)
            try:
                path, self._port = self._open_next()
            except PortBusyError as error:  # the search for its holder takes time: samples of other packs must not wait
                reason = await asyncio.to_thread(str, error)
            except (NoPortError, OSError) as error:
                reason = str(error)
            else:
                break
            self._say(f"waiting for {reason}")
        self.openings += 1
        self.lost.clear()
        self._reads.put_nowait((self.now_s, b""))
        asyncio.get_running_loop().add_reader(self._port.fileno(), self._read, self._port.fileno())
        return path

    def confirm(self) -> None:
        """Mark the device on the line as the wanted one: when it is lost, search for it at once."""
        self._retry_s = self._first_retry_s

    def close(self) -> None:
        """Close the port; it may be opened again."""
        if self._port is not None:
            asyncio.get_running_loop().remove_reader(self._port.fileno())
            self._port.close()
            self._port = None

    def finish(self) -> None:
        """Let the reader come to an end."""
        self._reads.put_nowait(None)

    async def read(self) -> Chunk | None:
        """Return the next chunk; an empty chunk after the port was opened, None at the end."""
        return await self._reads.get()

    def send(self, data: bytes) -> None:
        """Write. What a dying port does not take is lost."""
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
        self._reads.put_nowait((arrival_s, data))
