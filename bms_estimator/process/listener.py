"""TCP listener for HTTP servers with limits, because idle clients must not exhaust the descriptors of checkpoints and MQTT."""

import asyncio
import contextlib
import errno
import resource
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import structlog

HEADER_TIMEOUT_S = 10.0
"""Deadline from the connection to a complete request header [s]."""
IDLE_TIMEOUT_S = 30.0
"""Deadline from the end of a response to the next complete request header [s]."""
MAX_CONNECTIONS = 256
"""Maximum number of connections of all listeners of the process."""
DESCRIPTOR_FRACTION = 0.25
"""Fraction of RLIMIT_NOFILE that connections may use; the rest is reserved for checkpoints, databases and MQTT."""
ADDRESS_FRACTION = 0.5
"""Fraction of the connections that one client address may hold."""
BACKLOG = 128
"""Maximum number of connections that wait to be accepted."""
LOG_INTERVAL_S = 60.0
"""Minimum time between two log lines on failed accepts [s]."""
ACCEPT_RETRY_S = 1.0
"""Delay after a failed accept [s]."""
OPEN_RETRY_S = 10.0
"""Retry interval of an address that cannot be listened on [s]."""

log = structlog.get_logger(__name__)


def is_free(port: int) -> bool:
    """Return True if this user may listen on a TCP port of 127.0.0.1, and no program does."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port with old connections in TIME_WAIT is free
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):  # EACCES: a privileged port
                return False
            raise
    return True


def _default_limit() -> int:
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MAX_CONNECTIONS
    return max(2, min(MAX_CONNECTIONS, int(DESCRIPTOR_FRACTION * soft)))


@dataclass(eq=False)
class _Connection:
    """Open connection of a client."""

    client_socket: socket.socket
    transport: asyncio.Transport
    address: str
    deadline: asyncio.TimerHandle
    serving: bool = False
    """True while a request is handled."""
    unsent: int = 0
    """Unsent bytes of the response when the deadline was last set."""

    @property
    def is_busy(self) -> bool:
        """True while a request is handled or a response is being sent."""
        return self.serving or self.transport.get_write_buffer_size() > 0


class Connections:
    """Open connections, limited in total and for each address.

    A new connection beyond a limit displaces the oldest connection without a request in progress. If all connections have a
    request in progress, the new connection is refused.

    Args:
        limit: Maximum number of connections; None derives it from RLIMIT_NOFILE.
    """

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit or _default_limit()
        self._address_limit = max(1, int(ADDRESS_FRACTION * self.limit))
        self._by_transport: dict[asyncio.BaseTransport, _Connection] = {}

    def __len__(self) -> int:
        """Return the number of open connections."""
        self._prune()
        return len(self._by_transport)

    def add(self, client_socket: socket.socket, transport: asyncio.Transport, address: str) -> None:
        """Add a connection and start the deadline of its first request; close it if the limits do not allow it."""
        if not self._allow_one_more(address):
            transport.abort()
            return
        deadline = asyncio.get_running_loop().call_later(HEADER_TIMEOUT_S, transport.abort)
        self._by_transport[transport] = _Connection(client_socket, transport, address, deadline)

    @contextlib.contextmanager
    def serving(self, transport: asyncio.BaseTransport | None) -> Iterator[None]:
        """Exempt a connection from deadline and displacement while its request is handled."""
        connection = self._by_transport.get(transport) if transport else None
        if connection is None:
            yield
            return
        connection.deadline.cancel()
        connection.serving = True
        try:
            yield
        finally:
            connection.serving = False
            self._start_deadline(connection)

    def _start_deadline(self, connection: _Connection) -> None:
        """Start the deadline of the next request, or of the response that is being sent."""
        connection.unsent = connection.transport.get_write_buffer_size()
        connection.deadline = asyncio.get_running_loop().call_later(IDLE_TIMEOUT_S, self._expire, connection)

    def _expire(self, connection: _Connection) -> None:
        """Close a connection, unless its client has read a part of the response since the deadline was set."""
        unsent = connection.transport.get_write_buffer_size()
        # a response that was begun after the deadline was set had no unsent bytes then
        if unsent and (not connection.unsent or unsent < connection.unsent):
            self._start_deadline(connection)
        else:
            connection.transport.abort()

    def _allow_one_more(self, address: str) -> bool:
        """Return True if an address may have one more connection; close an idle one if necessary."""
        self._prune()
        own = [each for each in self._by_transport.values() if each.address == address]
        if len(own) >= self._address_limit:
            return self._displace(own)
        return len(self._by_transport) < self.limit or self._displace(list(self._by_transport.values()))

    def _displace(self, candidates: list[_Connection]) -> bool:
        idle = next((each for each in candidates if not each.is_busy), None)
        if idle is None:
            return False
        self._drop(idle)
        idle.transport.abort()
        return True

    def _prune(self) -> None:
        """Remove the connections whose descriptor is closed."""
        for each in list(self._by_transport.values()):
            if each.client_socket.fileno() < 0:
                self._drop(each)

    def _drop(self, connection: _Connection) -> None:
        connection.deadline.cancel()
        del self._by_transport[connection.transport]


CONNECTIONS = Connections()
"""Connections of this process, shared by all listeners, because they share its descriptors."""


class Listener:
    """Listener that accepts connections on one address.

    Args:
        protocol: Protocol factory, such as aiohttp's ``web.Server``.
        connections: Limits.
    """

    def __init__(
        self, protocol: Callable[[], asyncio.BaseProtocol | None], connections: Connections = CONNECTIONS
    ) -> None:
        self._protocol, self._connections = protocol, connections
        self._sockets: list[socket.socket] = []
        self._connecting: set[asyncio.Task[None]] = set()
        self._resuming: dict[socket.socket, asyncio.TimerHandle] = {}  # end of the pause of each paused socket
        self._opening: asyncio.Task[None] | None = None
        self._log_time_s = -LOG_INTERVAL_S

    async def open(self, host: str, port: int) -> int:
        """Listen and return the port.

        Raises:
            OSError: The address cannot be listened on.
        """
        loop = asyncio.get_running_loop()
        infos = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        try:
            for family, (address, *_) in dict.fromkeys((family, sockaddr) for family, *_, sockaddr in infos):
                listening = _listen_on(family, str(address), port)
                self._sockets.append(listening)
                port = listening.getsockname()[1]  # all addresses get the port that the system chose for the first
        except OSError:
            self._close_sockets()
            raise
        for each in self._sockets:
            self._resume(each)
        return port

    async def open_or_retry(self, host: str, port: int, name: str, on_open: Callable[[int], object] = int) -> None:
        """Listen. If the address is in use or does not exist yet, log it, return, and retry every ``OPEN_RETRY_S``.

        Args:
            host: Address.
            port: Port.
            name: Name of the service in the log.
            on_open: Called with the port once the address is listened on. The default has no effect.
        """
        try:
            on_open(await self.open(host, port))
        except OSError as error:
            log.warning("cannot listen yet; retrying", service=name, host=host, port=port, reason=error.strerror)
            self._opening = asyncio.create_task(self._open_later(host, port, on_open), name="listener")

    async def _open_later(self, host: str, port: int, on_open: Callable[[int], object]) -> None:
        while True:
            await asyncio.sleep(OPEN_RETRY_S)
            with contextlib.suppress(OSError):  # the first failure was logged
                on_open(await self.open(host, port))
                return

    async def close(self) -> None:
        """Stop accepting. The server closes the open connections."""
        if self._opening:
            self._opening.cancel()
            await asyncio.wait([self._opening])
        for timer in self._resuming.values():
            timer.cancel()
        self._resuming.clear()
        self._close_sockets()
        await asyncio.gather(*self._connecting, return_exceptions=True)

    def _close_sockets(self) -> None:
        for each in self._sockets:
            asyncio.get_running_loop().remove_reader(each)
            each.close()
        self._sockets = []

    def _accept(self, listening: socket.socket) -> None:
        """Accept one connection. The event loop calls this method again while others wait."""
        try:
            client_socket, address = listening.accept()
        except (BlockingIOError, InterruptedError, ConnectionError):  # the client has closed the connection meanwhile
            return
        except OSError as error:
            self._log_failure(error)
            self._pause(listening)
            return
        task = asyncio.create_task(self._serve(client_socket, str(address[0])), name="connection")
        self._connecting.add(task)
        task.add_done_callback(self._connecting.discard)

    def _pause(self, listening: socket.socket) -> None:
        """Accept no connection for ``ACCEPT_RETRY_S``, because the event loop would call ``_accept`` all the time."""
        loop = asyncio.get_running_loop()
        loop.remove_reader(listening)
        self._resuming[listening] = loop.call_later(ACCEPT_RETRY_S, self._resume, listening)

    def _resume(self, listening: socket.socket) -> None:
        self._resuming.pop(listening, None)
        asyncio.get_running_loop().add_reader(listening, self._accept, listening)

    async def _serve(self, client_socket: socket.socket, address: str) -> None:
        try:
            transport, _ = await asyncio.get_running_loop().connect_accepted_socket(self._make_protocol, client_socket)
        except OSError:
            client_socket.close()
            return
        self._connections.add(client_socket, transport, address)

    def _make_protocol(self) -> asyncio.BaseProtocol:
        protocol = self._protocol()
        if protocol is None:  # the server is shutting down
            raise ConnectionAbortedError
        return protocol

    def _log_failure(self, error: OSError) -> None:
        now_s = time.monotonic()
        if now_s >= self._log_time_s + LOG_INTERVAL_S:
            self._log_time_s = now_s
            log.warning("connections cannot be accepted", reason=error.strerror)


def _listen_on(family: int, address: str, port: int) -> socket.socket:
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setblocking(False)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listening.bind((address, port))
        listening.listen(BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening
