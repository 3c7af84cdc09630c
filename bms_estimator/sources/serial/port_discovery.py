"""Candidate ports of a board: the configured one or, with a known serial number, any with a board's chip."""

import math
import os
import time
from collections.abc import Callable

from bms_estimator.sources.serial.port_list import NoPortError, board_ports, resolve_port

WRONG_PORT_RETRY_S = 60.0
"""Time until a port with another board is opened again while there are other ports [s]: opening may reset a device."""
BUSY_PORT_RETRY_S = 1.0
"""Time until a port that could not be opened is tried again [s]: another search may have held it."""


class PortDiscovery:
    """Choice of the next port to try.

    Args:
        port: Device path, or ``auto``.
        monotonic: Monotonic clock [s].

    Attributes:
        is_preferred: True if a silent device on the last chosen port is waited for. Otherwise the port may belong to another device
            and is left soon.
    """

    def __init__(self, port: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._port, self._monotonic = port, monotonic
        self._left: dict[str, tuple[float, float]] = {}  # path: when it was left, until when it is
        self.is_preferred = True

    def next(self, serial: str) -> str:
        """Device path to open now.

        Args:
            serial: Serial number of the wanted board; empty if it cannot be recognized on another port.

        Raises:
            NoPortError: No such port.
        """
        if not serial:
            self.is_preferred = True
            return resolve_port(self._port)
        there = board_ports()
        if self._port == "auto":
            home = there if len(there) == 1 else []
        else:
            home = [self._port] if os.path.exists(self._port) else []  # noqa: PTH110 - as in ``resolve_port``
        known = {os.path.realpath(path) for path in home}
        places, now_s = home + [path for path in there if os.path.realpath(path) not in known], self._monotonic()
        if not places:
            resolve_port(self._port)  # reports the reason
        self._left = {path: times for path, times in self._left.items() if path in places}
        never = (-math.inf, -math.inf)
        fresh = [path for path in places if self._left.get(path, never)[1] <= now_s] or home
        if not fresh:
            raise NoPortError(f"{self._port}: board {serial} is not there, nor on {', '.join(places)}")
        chosen = min(fresh, key=lambda path: self._left.get(path, never)[0])  # each has its turn
        self.is_preferred = chosen in home
        return chosen

    def skip_port(self, path: str, seconds: float) -> None:
        """Try the other ports first for some time."""
        now_s = self._monotonic()
        self._left[path] = now_s, now_s + seconds
