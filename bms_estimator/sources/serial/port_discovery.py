"""Choice of the port to open.

If the serial number of the board is unknown, only the configured port is opened. If the number is known, all ports with one
of the usual USB-serial chips are also candidates, because the board may have been moved to another port.
"""

import math
import os
import time
from collections.abc import Callable

from bms_estimator.sources.serial.port_list import NoPortError, board_ports, resolve_port

WRONG_PORT_RETRY_S = 60.0
"""Time until a port with another device is reopened while there are other ports [s]. Opening may reset that device."""
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
