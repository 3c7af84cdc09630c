"""sd_notify: status messages for systemd on its datagram socket."""

import os
import socket
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

CREDENTIALS = Path("/run/credentials")
"""Folder with the credentials of all systemd units."""
START_EXTENSION_S = 120
"""Time by which each message extends the start timeout of the unit [s]."""


class SystemdNotifier:
    """Sender of states to the socket of ``NOTIFY_SOCKET``. It does nothing without the variable.

    One process may serve several packs, but is a single service for systemd. A state is therefore sent when
    every pack has reported it. Afterwards every pack must report it again. As a result the service is ready when the last
    pack is ready, and the watchdog is fed only while all packs are alive.

    Args:
        packs: Names of the packs.
        environment: Environment with ``NOTIFY_SOCKET`` and ``WATCHDOG_USEC``.
        activity: Verb of the status text.
    """

    def __init__(
        self, packs: Collection[str], environment: Mapping[str, str] = os.environ, *, activity: str = "estimating"
    ) -> None:
        self._packs, self._activity = frozenset(packs), activity
        self._awaited: dict[str, set[str]] = {}  # packs that have yet to report, by state
        self._texts = dict.fromkeys(packs, "")
        self._socket = environment.get("NOTIFY_SOCKET", "")
        is_watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = float(environment.get("WATCHDOG_USEC", "0")) / 1e6 if is_watched else 0.0
        """Watchdog timeout of systemd [s]; 0: no watchdog."""

    def ready(self, pack: str) -> None:
        """Report that the pack's loop runs."""
        self._send_once_all_reported(pack, "READY=1", f"\n{self._status}")

    def status(self, pack: str, text: str) -> None:
        """Set the pack's status text for ``systemctl status``."""
        self._texts[pack] = text
        _send(self._socket, self._status)

    def alive(self, pack: str) -> None:
        """Report that the pack's loop is alive."""
        self._send_once_all_reported(pack, "WATCHDOG=1")

    def stopping(self, pack: str) -> None:
        """Report that the pack's loop has ended."""
        self._send_once_all_reported(pack, "STOPPING=1")

    @property
    def _status(self) -> str:
        packs = (f"{pack}: {text}" if text else pack for pack, text in sorted(self._texts.items()))
        return f"STATUS={self._activity} {', '.join(packs)}"

    def _send_once_all_reported(self, pack: str, state: str, suffix: str = "") -> None:
        """Record that a pack has reported a state; send the state when all packs have."""
        awaited = self._awaited.setdefault(state, set(self._packs))
        awaited.discard(pack)
        if not awaited:
            del self._awaited[state]
            _send(self._socket, f"{state}{suffix}")


def extend_start(status: str) -> None:
    """Extend the start timeout of the systemd unit by ``START_EXTENSION_S``, and set its status text."""
    _send(os.environ.get("NOTIFY_SOCKET", ""), f"EXTEND_TIMEOUT_USEC={START_EXTENSION_S * 10**6}\nSTATUS={status}")


def _send(address: str, state: str) -> None:
    """Send a state to the socket of systemd; ignore errors, because the service works without it."""
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel, suppress(OSError):
        channel.setblocking(False)
        channel.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


def credential_path(name: Path) -> Path:
    """Return the path of this file name in ``$CREDENTIALS_DIRECTORY`` if it exists there, else ``name`` itself."""
    path = Path(os.environ.get("CREDENTIALS_DIRECTORY", ""), name)
    return path if os.access(path, os.R_OK) else name


def is_unreadable_credential(name: Path) -> bool:
    """Return True if ``name`` is the name or path of a systemd credential that this process cannot read.

    The service may be able to read it.
    """
    # a relative name is looked up in the folder of the credentials
    is_credential = not name.is_absolute() or name.is_relative_to(CREDENTIALS)
    return is_credential and not os.access(credential_path(name), os.R_OK)
