"""Connection of a fleet service to the server. It reconnects without limit and does not repeat log lines."""

import asyncio
import contextlib
import logging
import re
import ssl
import time
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import nats.aio.client
import nats.errors
import nats.js.errors
import structlog
from nats.aio.client import Client
from nats.aio.transport import TcpTransport

from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.runtime import result_before

Result = TypeVar("Result")
"""Result of ``retry_until_ready``."""
_TEXT_BY_CLASS: dict[type[BaseException], str] = {
    nats.js.errors.NotFoundError: "a stream is missing on the server: create it with `bms-estimator fleet serve`",
    nats.js.errors.NoStreamResponseError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.errors.NoRespondersError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.js.errors.ServiceUnavailableError: "the server's streams are not available now",
    nats.js.errors.APIError: "the server rejects the request",
    nats.errors.AuthorizationError: "the server rejects these credentials: check --creds",
    TimeoutError: "no answer in time: are most nodes up, and is it the port for workers (4222)?",  # nats.errors.TimeoutError is a subclass
    ConnectionRefusedError: "connection refused: no server listens on this address",
}
"""Error texts by exception class. The first matching class applies."""

_TEXT_BY_PART = {
    "authorization violation": "the server requires credentials, or rejects these: check --creds",
    "permissions violation": "these credentials do not permit this: check --creds",
    "certificate_verify_failed": "the server's certificate is not trusted, or is for another name: check --ca",
}
"""Error texts by part of the library's error text, for errors that have no exception class of their own."""

AUTH_TIMEOUT_S = 10
"""Timeout of each authentication step [s], long enough for a slow link or many simultaneous reconnections. The server's
default is 2 s."""

CONNECT_RETRY_S = 1
"""Delay between two connection attempts [s]."""
RETRY_S = 0.5
"""Retry interval of server requests [s]."""
RETRYABLE_ERRORS = (nats.errors.Error, TimeoutError, StreamError)
"""Errors of the connection or the server after which a request is repeated."""
PING_S = 10
"""Ping interval [s]. After two unanswered pings the client reconnects."""
FLUSH_TIMEOUT_S = 5.0
"""Timeout of a flush [s]. Without a timeout, a server that stops reading would block the flush forever."""
CLOSE_TIMEOUT_S = 3.0
"""Timeout of closing a transport, after which the transport is aborted [s]."""
CLIENT_CLOSE_TIMEOUT_S = 2.0 * CLOSE_TIMEOUT_S
"""Timeout of closing a client [s]. It exceeds the transport's timeout, so that the transport can be aborted first."""
REPEATED_LOG_S = 30.0
"""Minimum interval between two log lines with equal error texts [s]."""

log = structlog.get_logger(__name__)
# nats-py causes this asyncio warning whenever a TLS connection ends; a user cannot act on it.
logging.getLogger("asyncio").addFilter(lambda record: "eof_received() has no effect" not in str(record.msg))


class _Transport(TcpTransport):
    """Transport whose closing has a timeout.

    Closing may never complete after a failed TLS handshake, and while a server does not read the bytes sent.
    """

    async def wait_closed(self) -> None:
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await super().wait_closed()  # type: ignore[no-untyped-call]
        except TimeoutError:
            if self._io_writer is not None:
                self._io_writer.transport.abort()


nats.aio.client.TcpTransport = _Transport  # type: ignore[attr-defined] # nats-py has no option for the transport


async def connect(
    servers: str,
    name: str,
    *,
    creds: Path | None = None,
    ca: Path | None = None,
    on_link_change: Callable[[str | None], None] = lambda _: None,
) -> Client:
    """Connect, retrying without limit; reconnect whenever the connection breaks.

    Args:
        servers: Address ``nats://host:port`` or ``tls://host:port``, or several separated by commas.
        name: Name of this connection, in the server's lists.
        creds: Credentials file of the tenant, made by ``fleet serve``; None: without credentials.
        ca: Certificate of the authority that signed the server's certificate; None: the system's authorities.
        on_link_change: Called with the reason when the connection is lost or fails, and with None when it is restored.

    Raises:
        UserError: ``creds`` or ``ca`` cannot be read, or an address is not valid.
    """
    nc = Client()
    events = _ConnectionEvents(nc, servers, on_link_change)
    try:
        await nc.connect(
            servers=parse_addresses(servers),
            name=name,
            user_credentials=str(check_credentials_file(creds)) if creds else None,
            tls=tls_context(ca) if ca else None,
            max_reconnect_attempts=-1,
            reconnect_time_wait=CONNECT_RETRY_S,
            ping_interval=PING_S,
            connect_timeout=AUTH_TIMEOUT_S,
            flush_timeout=FLUSH_TIMEOUT_S,
            error_cb=events.on_error,
            disconnected_cb=events.on_disconnect,
            reconnected_cb=events.on_reconnect,
        )
    except ValueError as error:
        raise UserError(f"--server {servers}: {error}") from error
    except asyncio.CancelledError:
        await close(nc)  # the library leaves the socket open
        raise
    return nc


async def run_connected(
    run: Callable[[Client], Awaitable[None]],
    stop: asyncio.Event,
    connection: Coroutine[Any, Any, Client],
) -> None:
    """Connect, run a service, and close the connection. If ``stop`` is set before a server is found, nothing is run.

    Args:
        run: Runs the service until ``stop`` is set.
        stop: Event that ends the service.
        connection: Call of ``connect``.

    Raises:
        UserError: The address cannot be used.
    """
    nc = await result_before(stop, connection)
    if nc is None:
        return
    try:
        await run(nc)
    finally:
        await close(nc)


async def retry_until_ready(
    nc: Client, servers: str, attempt: Callable[[], Awaitable[Result]], event: str = "waiting for the server"
) -> Result:
    """Return the result of ``attempt``, which is repeated until the server has all that it needs.

    Args:
        nc: Connection to the tenant's NATS account.
        servers: Address of the server, for the error.
        attempt: Function that raises one of ``RETRYABLE_ERRORS`` or a ``UserError`` if it has to be repeated.
        event: Event of the log lines, one for each new reason.

    Raises:
        TemporaryError: The server has closed the connection permanently.
    """
    last_reason = ""
    while True:
        try:
            return await attempt()
        except (*RETRYABLE_ERRORS, UserError) as error:
            raise_if_closed(nc, servers)
            if (text := error_text(error)) != last_reason:
                log.warning(event, reason=text)
            last_reason = text
        await asyncio.sleep(RETRY_S)


def raise_if_closed(nc: Client, servers: str) -> None:
    """Raise an error if the connection is closed and will not be restored.

    Raises:
        TemporaryError: The server has closed the connection permanently.
    """
    if nc.is_closed:
        raise TemporaryError(f"the server {servers} has closed the connection: check --creds")


async def close(nc: Client) -> None:
    """Close a connection in any state."""
    with contextlib.suppress(nats.errors.Error, OSError, TimeoutError):
        async with asyncio.timeout(CLIENT_CLOSE_TIMEOUT_S):
            await nc.close()


def parse_addresses(servers: str) -> list[str]:
    """Return the server addresses of a comma-separated list.

    Raises:
        UserError: An address is invalid or of another protocol.
    """
    addresses = [each.strip() for each in servers.split(",")]
    if not all(re.fullmatch(r"((nats|tls)://)?[^/\s]+", each) for each in addresses):
        raise UserError(
            f"--server {servers}: must be nats://host:port or tls://host:port, or several separated by commas"
        )
    return addresses


def check_credentials_file(creds: Path) -> Path:
    """Check the content of a credentials file and return its path.

    Raises:
        UserError: The file cannot be read or is not a credentials file.
    """
    try:
        data = creds.read_bytes()
    except OSError as error:
        raise UserError(f"--creds {creds}: cannot be read: {error.strerror}") from None
    if b"BEGIN NATS USER JWT" not in data or b"BEGIN USER NKEY SEED" not in data:
        raise UserError(
            f"--creds {creds}: not a credentials file; `fleet serve` creates them, such as keys/TENANT/worker.creds"
        )
    return creds


def tls_context(ca: Path) -> ssl.SSLContext:
    """Return a TLS context that trusts one certificate authority.

    Raises:
        UserError: The file cannot be read.
    """
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise UserError(f"--ca {ca}: {error.strerror or error}") from error


class _ConnectionEvents:
    """Callbacks of a connection, which log and report errors and changes of the connection."""

    def __init__(self, nc: Client, servers: str, on_link_change: Callable[[str | None], None]) -> None:
        self._nc, self._servers, self._on_link_change = nc, servers, on_link_change
        self._logged_text, self._logged_s = "", 0.0  # text and time of the last logged error

    async def on_error(self, error: Exception) -> None:
        text, now_s = error_text(error), time.monotonic()
        if not self._nc.is_connected:
            self._on_link_change(text)
        if text != self._logged_text or now_s >= self._logged_s + REPEATED_LOG_S:
            self._logged_text, self._logged_s = text, now_s
            log.warning("error of the connection to the server", server=self._servers, reason=text)

    async def on_disconnect(self) -> None:
        if self._nc.is_closed:  # closed by this process
            return
        self._on_link_change("the connection is lost")
        log.warning("the connection to the server is lost; reconnecting", server=self._servers)

    async def on_reconnect(self) -> None:
        self._logged_text, self._logged_s = "", 0.0
        self._on_link_change(None)
        log.info("reconnected to the server", server=self._servers)


def error_text(error: BaseException) -> str:
    """Return the text of an error of NATS or of the connection, with a remedy if one is known."""
    text = str(getattr(error, "description", None) or error).removeprefix("nats: ") or type(error).__name__
    for error_class, reason in _TEXT_BY_CLASS.items():
        if isinstance(error, error_class):
            return f"{reason} ({text})" if isinstance(error, nats.js.errors.APIError) else reason
    for part_of_text, reason in _TEXT_BY_PART.items():
        if part_of_text in text.lower():
            return f"{reason} ({text})"
    return text
