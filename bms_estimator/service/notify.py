"""sd_notify: what systemd wants to hear, on its datagram socket."""

import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends states to the socket of ``NOTIFY_SOCKET``; silent where there is none.

    Args:
        environment: Where ``NOTIFY_SOCKET`` and ``WATCHDOG_USEC`` are looked up.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        for_us = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = float(environment.get("WATCHDOG_USEC", "0")) / 1e6 if for_us else 0.0
        """Time after which systemd takes us for dead [s]; 0: it does not watch."""

    def send(self, *lines: str) -> None:
        """Send ``READY=1``, ``WATCHDOG=1``, ``STOPPING=1``, ``STATUS=...``; a deaf systemd is no reason to fail."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.setblocking(False)
            try:
                channel.sendto("\n".join(lines).encode(), self._address)
            except OSError:
                return
