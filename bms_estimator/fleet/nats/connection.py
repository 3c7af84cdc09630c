"""Connection of a fleet service to the server: reconnects without limit and reports each trouble once."""

import asyncio
import contextlib
import logging
import re
import ssl
import time
from collections.abc import Callable
from pathlib import Path

import nats.aio.client
import nats.errors
import nats.js.errors
import structlog
from nats.aio.client import Client
from nats.aio.transport import TcpTransport

from bms_estimator.model.errors import UserError

_REASONS: dict[type[BaseException], str] = {
    nats.js.errors.NotFoundError: "the server lacks one of the streams: make them with `bms-estimator fleet serve`",
    nats.js.errors.NoStreamResponseError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.errors.NoRespondersError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.js.errors.ServiceUnavailableError: "the server's streams are not available now",
    nats.js.errors.APIError: "the server refuses",
    nats.errors.AuthorizationError: "the server refuses these credentials: look at --creds",
    TimeoutError: "no answer in time: are most nodes up, and is it the port for workers (4222)?",  # that of NATS is one, too
    ConnectionRefusedError: "nobody listens there",
}
"""The first that an error is one of."""

_WORDS = {
    "authorization violation": "the server refuses these credentials, or asks for some: look at --creds",
    "permissions violation": "these credentials may not do that: look at --creds",
    "certificate_verify_failed": "its certificate is of nobody whom we trust, or names another server: look at --ca",
}
"""Errors that the library reports as text only."""

LET_IN_S = 10
"""Timeout of each step of an authentication [s], on a slow line or while many reconnect at once. The server's default
is 2."""

RETRY_S = 1
"""Delay between two connection attempts [s]."""
PING_S = 10
"""Ping interval [s]; a connection without two responses is reconnected."""
FLUSH_S = 5.0
"""Timeout of a flush to a server that reads nothing [s]."""
CLOSING_S = 3.0
"""Timeout of closing a connection [s]."""
SAID_S = 30.0
"""Minimum interval between two log lines about an equal error [s]."""

log = structlog.get_logger(__name__)
# The library's end of a TLS connection, which is not usable.
logging.getLogger("asyncio").addFilter(lambda record: "eof_received() has no effect" not in str(record.msg))


class _Transport(TcpTransport):
    """Closes within a time limit, because closing may never complete.

    This happens after a failed TLS handshake, and with bytes that a silent server does not read.
    """

    async def wait_closed(self) -> None:
        try:
            async with asyncio.timeout(CLOSING_S):
                await super().wait_closed()  # type: ignore[no-untyped-call]
        except TimeoutError:
            if self._io_writer is not None:
                self._io_writer.transport.abort()


nats.aio.client.TcpTransport = _Transport  # type: ignore[attr-defined] # the library has no option for it


async def connect(
    servers: str,
    name: str,
    *,
    creds: Path | None = None,
    ca: Path | None = None,
    linked: Callable[[str | None], None] = lambda _: None,
) -> Client:
    """Connect, however long that takes; later on, connect again whenever the connection breaks.

    Args:
        servers: ``nats://`` or ``tls://`` and host:port; several with commas between.
        name: Name of this connection, in the server's lists.
        creds: File of the tenant's credentials, as ``fleet serve`` made it; None: none are required.
        ca: Certificate of the authority that has signed the server's; None: those of the system.
        linked: Called with why there is no connection, and with None when there is one again.

    Raises:
        UserError: ``creds`` or ``ca`` cannot be read, or an address is not valid.
    """
    nc = Client()
    said = _Said(nc, servers, linked)
    try:
        await nc.connect(
            servers=addresses(servers),
            name=name,
            user_credentials=str(readable(creds)) if creds else None,
            tls=context(ca) if ca else None,
            max_reconnect_attempts=-1,
            reconnect_time_wait=RETRY_S,
            ping_interval=PING_S,
            connect_timeout=LET_IN_S,
            flush_timeout=FLUSH_S,
            error_cb=said.trouble,
            disconnected_cb=said.gone,
            reconnected_cb=said.back,
        )
    except ValueError as error:
        raise UserError(f"--server {servers}: {error}") from error
    return nc


async def part(nc: Client) -> None:
    """Close a connection in any state."""
    with contextlib.suppress(nats.errors.Error, OSError, TimeoutError):
        async with asyncio.timeout(2.0 * CLOSING_S):
            await nc.close()


def addresses(servers: str) -> list[str]:
    """One or several with commas between.

    Raises:
        UserError: One is of another protocol.
    """
    found = [each.strip() for each in servers.split(",")]
    if not all(re.fullmatch(r"((nats|tls)://)?[^/\s]+", each) for each in found):
        raise UserError(f"--server {servers}: must be nats://host:port or tls://host:port; several with commas")
    return found


def readable(creds: Path) -> Path:
    """Return the path of a credentials file after checking its content.

    Raises:
        UserError: It cannot be read, or holds none.
    """
    try:
        data = creds.read_bytes()
    except OSError as error:
        raise UserError(f"--creds {creds}: cannot be read: {error.strerror}") from None
    if b"BEGIN NATS USER JWT" not in data or b"BEGIN USER NKEY SEED" not in data:
        raise UserError(f"--creds {creds}: no credentials: `fleet serve` makes some, such as keys/TENANT/worker.creds")
    return creds


def context(ca: Path) -> ssl.SSLContext:
    """Trust in the authority of a certificate.

    Raises:
        UserError: It cannot be read.
    """
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise UserError(f"--ca {ca}: {error.strerror or error}") from error


class _Said:
    """Logs what becomes of a connection."""

    def __init__(self, nc: Client, servers: str, linked: Callable[[str | None], None]) -> None:
        self._nc, self._servers, self._linked = nc, servers, linked
        self._last: tuple[str, float] = ("", 0.0)

    async def trouble(self, error: Exception) -> None:
        text, now_s = error_text(error), time.monotonic()
        if not self._nc.is_connected:
            self._linked(text)
        if (text, True) != (self._last[0], now_s < self._last[1] + SAID_S):
            self._last = text, now_s
            log.warning("trouble with the server", server=self._servers, reason=text)

    async def gone(self) -> None:
        if self._nc.is_closed:  # by us
            return
        self._linked("the server is lost")
        log.warning("the connection to the server is gone; trying again", server=self._servers)

    async def back(self) -> None:
        self._last = ("", 0.0)
        self._linked(None)
        log.info("the server is back", server=self._servers)


def error_text(error: BaseException) -> str:
    """Return an error of NATS, or of the connection to it, as text."""
    said = str(getattr(error, "description", None) or error).removeprefix("nats: ") or type(error).__name__
    for kind, text in _REASONS.items():
        if isinstance(error, kind):
            return f"{text} ({said})" if isinstance(error, nats.js.errors.APIError) else text
    for words, text in _WORDS.items():
        if words in said.lower():
            return f"{text} ({said})"
    return said
