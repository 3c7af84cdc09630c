"""Serial port that is opened with pyserial, read by the event loop, and reopened when it is lost, for any protocol.

If the serial number of the board is unknown, only the configured port is opened. If the number is known, all ports with one
of the usual USB-serial chips are also candidates, because the board may have been moved to another port.
"""

import asyncio
import math
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.sources.serial.port_list import NoPortError, PortBusyError, board_ports, resolve_port
from bms_estimator.sources.source import FIRST_RETRY_S, MAX_RETRY_S, Chunk

if TYPE_CHECKING:
    import serial


WRONG_PORT_RETRY_S = 60.0
"""Time until a port with another device is reopened while there are other ports [s]. Opening may reset that device."""
SILENT_PORT_RETRY_S = 10.0
"""Time until a silent port is reopened while there are other ports [s]. Its board may have been starting or without power."""
BUSY_PORT_RETRY_S = 1.0
"""Time until a port that could not be opened is retried [s]. The search of another pack may have opened it."""


class PortDiscovery:
    """Chooses the next port to open. Candidates take turns.

    Args:
        port: Device path, or ``auto``.
        monotonic: Monotonic clock [s].

    Attributes:
        is_preferred: True if the last chosen port is the configured one. It stays open while its device is silent. Any other
            port may belong to another device. It is closed when its device is silent.
    """

    def __init__(self, port: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._port, self._monotonic = port, monotonic
        self._skipped: dict[str, tuple[float, float]] = {}  # begin and end of the skip by path [s]
        self.is_preferred = True

    def next(self, serial: str) -> str:
        """Return the device path to open now.

        Args:
            serial: Serial number of the wanted board; empty if unknown, so that only the configured port is a candidate.

        Raises:
            NoPortError: There is no candidate.
        """
        if not serial:
            self.is_preferred = True
            return resolve_port(self._port)
        boards = board_ports()
        if self._port == "auto":
            configured = boards if len(boards) == 1 else []
        else:
            configured = [self._port] if os.path.exists(self._port) else []  # noqa: PTH110 - as in ``resolve_port``
        configured_devices = {os.path.realpath(path) for path in configured}
        candidates = configured + [path for path in boards if os.path.realpath(path) not in configured_devices]
        now_s = self._monotonic()
        if not candidates:
            resolve_port(self._port)  # raises NoPortError with the reason
        self._skipped = {path: times for path, times in self._skipped.items() if path in candidates}
        not_skipped = (-math.inf, -math.inf)
        due = [path for path in candidates if self._skipped.get(path, not_skipped)[1] <= now_s]
        due = due or configured  # while all candidates are skipped, the configured port is retried
        if not due:
            raise NoPortError(f"{self._port}: board {serial} was found neither there nor on {', '.join(candidates)}")
        # the port that was skipped longest ago; a port that was never skipped comes first
        chosen = min(due, key=lambda path: self._skipped.get(path, not_skipped)[0])
        self.is_preferred = chosen in configured
        return chosen

    def skip_port(self, path: str, seconds: float) -> None:
        """Prefer the other ports for some time."""
        now_s = self._monotonic()
        self._skipped[path] = now_s, now_s + seconds


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
        first_retry_s: First delay before a missing or lost port is retried [s].

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
