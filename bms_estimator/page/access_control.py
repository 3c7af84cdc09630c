"""Access control of the page by host name and token, without I/O.

A foreign page in the same browser may send requests to this server under its own host name (DNS rebinding). Therefore only
the names of this server are accepted.
"""

import hashlib
import hmac
import ipaddress
import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from bms_estimator.model.errors import TemporaryError
from bms_estimator.process.systemd import credential_path
from bms_estimator.settings.connections import PageSettings

MIN_TOKEN_CHARACTERS = 16
"""Minimum length of a token [characters]; `openssl rand -hex 16` generates 32."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of every response. They forbid loading from other servers, framing, and referrers, which may contain a token."""


class AccessControl:
    """Check of requests for host name and token.

    Args:
        hosts: Host names of this server, in addition to addresses, ``localhost`` and the machine's name.
        token: Required token; None: no token is required.
    """

    def __init__(self, hosts: Iterable[str] = (), token: str | None = None) -> None:
        machine = socket.gethostname().lower()
        self._hosts = {"localhost", machine, f"{machine}.local", *(host.lower() for host in hosts)}
        self._token = token.encode() if token is not None else None

    @property
    def cookie(self) -> str:
        """Cookie that replaces the token in a browser."""
        return hashlib.sha256(b"bms-estimator page " + (self._token or b"")).hexdigest()

    def is_own_host(self, header: str) -> bool:
        """Return True if a ``Host`` header names this server. Addresses are accepted, because DNS cannot redirect them."""
        try:
            host = urlsplit(f"//{header}").hostname or ""
        except ValueError:
            return False
        return host in self._hosts or _is_address(host)

    def is_valid_token(self, token: str) -> bool:
        """Return True for the right token, or if none is required. The time of the comparison does not depend on the token."""
        return self._token is None or hmac.compare_digest(_encode_header(token), self._token)

    def is_valid_cookie(self, cookie: str) -> bool:
        """Return True for the cookie of the token, or if none is required."""
        return self._token is None or hmac.compare_digest(_encode_header(cookie), self.cookie.encode())


def make_access_control(settings: PageSettings, token: str | None = None) -> AccessControl:
    """Make the access control of the settings.

    Args:
        settings: Host names of the page, and the file with its token.
        token: Required token if the settings name no file; None: no token is required.

    Raises:
        TemporaryError: The token cannot be read, or is too short.
    """
    return AccessControl((settings.address.host, *settings.hosts), _token(settings) or token)


def _token(settings: PageSettings) -> str | None:
    """Read the token; None if the settings name no file."""
    name = settings.token_file
    if name is None:
        return None
    try:
        token = credential_path(name).read_text(encoding="utf-8").strip()
    except OSError as error:
        raise TemporaryError(f"page.token_file = {name}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:  # the text of the error would show bytes of the token
        raise TemporaryError(f"page.token_file = {name}: cannot be read: not UTF-8 text") from None
    if len(token) < MIN_TOKEN_CHARACTERS:
        raise TemporaryError(
            f"page.token_file = {name}: the token has {len(token)} letters, must have {MIN_TOKEN_CHARACTERS} or more; "
            f"`openssl rand -hex 16` makes one (docs/pack/page.md)"
        )
    return token


def _encode_header(header: str) -> bytes:
    """Return a header as received: aiohttp passes invalid UTF-8 as surrogates."""
    return header.encode(errors="surrogateescape")


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
