"""HTTP server of a page: static files, event stream, queries, forms."""

import asyncio
import contextlib
import hashlib
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, Self, cast

import structlog
from aiohttp import web

from bms_estimator.model.errors import UserError
from bms_estimator.page.access_control import HEADERS, AccessControl, make_access_control
from bms_estimator.page.event_stream import LatestValues, Reader
from bms_estimator.process.listener import CONNECTIONS, Listener
from bms_estimator.settings.connections import PageSettings

PING_S = 5.0
"""Interval of keep-alive events without news [s]. The page counts the connection as lost after three intervals of silence."""
WRITE_S = 30.0
"""Time without progress after which a reader is disconnected [s]."""
MAX_STREAMS = 32
"""Maximum number of concurrent event streams."""
COOKIE_S = 31_536_000
"""Lifetime of the cookie, one year [s]."""
SHUTDOWN_TIMEOUT_S = 1.0
"""Timeout of open connections at shutdown [s]."""

LOGIN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>bms_estimator</title><form action="/" method="get">
<p><label>Token <input name="token" type="password" autofocus autocomplete="off"></label> <button>Open</button></p>
<p>It is in the file token_file of the page's settings, or in the terminal of bms-estimator setup.</p></form></html>"""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

log = structlog.get_logger(__name__)


class File(NamedTuple):
    """File that is served unchanged."""

    path: Path
    media_type: str


class _LoadedFile(NamedTuple):
    """File in memory, with its media type and its HTTP entity tag."""

    body: bytes
    media_type: str
    etag: str


class _Stream(NamedTuple):
    """Open event stream of a client."""

    address: str | None
    transport: asyncio.Transport | None


class WebServer:
    """HTTP server of a page; a context manager.

    Args:
        settings: Address and access of the page.
        files: Static files by the path of their URL.
        latest: Content of the event stream ``/events``.
        handlers: Handlers of queries, by path.
        forms: Handlers of submitted forms, by path.
        max_form_bytes: Maximum size of a submitted form [bytes].
        token: Required token if the settings name no file with one; None: no token is required.
        on_listening: Called with the address once the server listens; ``str`` ignores it.
        retry: True: retry an address that is in use or does not exist yet; False: raise an error.

    Raises:
        UserError: The token cannot be read.
    """

    def __init__(
        self,
        settings: PageSettings,
        files: Mapping[str, File],
        latest: LatestValues,
        handlers: Mapping[str, Handler],
        *,
        forms: Mapping[str, Handler] = MappingProxyType({}),
        max_form_bytes: int = 1024,
        token: str | None = None,
        on_listening: Callable[[str], object] = str,
        retry: bool = True,
    ) -> None:
        self._latest, self._on_listening, self._retry = latest, on_listening, retry
        self._access: AccessControl = make_access_control(settings, token)
        self._configured_address, self._bound_address = settings.address, settings.address
        self._files = {path: _load_file(file) for path, file in files.items()}
        self._handlers = {**dict.fromkeys(files, self._send_file), "/events": self._stream_events, **handlers}
        self._forms, self._max_form_bytes = forms, max_form_bytes
        self._streams: dict[Reader, _Stream] = {}
        self._runner: web.AppRunner | None = None
        self._listener: Listener | None = None

    @property
    def url(self) -> str:
        """Address at which a browser on this machine finds the page."""
        host, port = self._bound_address
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104 - configured, and with a token only
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/"

    async def __aenter__(self) -> Self:
        """Start to listen on the address.

        Raises:
            UserError: The address cannot be listened on, and ``retry`` is False.
        """
        app = web.Application(middlewares=[self._exempt_connection], client_max_size=self._max_form_bytes)
        app.on_response_prepare.append(_set_security_headers)
        for path, handler in self._handlers.items():
            app.router.add_get(path, handler)
        for path, handler in self._forms.items():
            app.router.add_post(path, handler)
        self._runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=SHUTDOWN_TIMEOUT_S)
        await self._runner.setup()
        self._listener = Listener(cast("web.Server", self._runner.server))
        host, port = self._configured_address.host, self._configured_address.port
        if self._retry:
            await self._listener.open_or_retry(host, port, "page", self._on_open)
            return self
        try:
            self._on_open(await self._listener.open(host, port))
        except OSError as error:
            await self._runner.cleanup()
            raise UserError(f"page.listen = {host}:{port}: {error.strerror}; name another one") from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """End all streams and connections, and stop listening."""
        self._latest.close()
        if self._listener:
            await self._listener.close()
        if self._runner:
            await self._runner.cleanup()

    def _on_open(self, port: int) -> None:
        self._bound_address = self._configured_address._replace(port=port)
        log.info("live page", url=self.url)
        self._on_listening(self.url)

    @web.middleware
    async def _exempt_connection(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Prevent that a new connection displaces this one while its request is handled."""
        with CONNECTIONS.serving(request.transport):
            return await self._authorize(request, handler)

    async def _authorize(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Require a permitted host name and the token."""
        if not self._access.is_own_host(request.headers.get("Host", "")):
            raise web.HTTPForbidden(text="host name not accepted: add it to page.hosts, or --host\n")
        token = request.query.get("token")
        if token is not None and self._access.is_valid_token(token):
            return self._set_cookie()
        authorization = request.headers.get("Authorization", "")
        if self._access.is_valid_cookie(request.cookies.get(self._cookie_name, "")):
            return await handler(request)
        if authorization.startswith("Bearer ") and self._access.is_valid_token(authorization.removeprefix("Bearer ")):
            return await handler(request)
        raise web.HTTPUnauthorized(text=LOGIN_PAGE, content_type="text/html", headers={"WWW-Authenticate": "Bearer"})

    @property
    def _cookie_name(self) -> str:
        """Name of the cookie. It contains the port, because browsers share cookies between the ports of a host."""
        return f"bms_page_{self._bound_address.port}"

    def _set_cookie(self) -> web.Response:
        """Set the cookie, and redirect to the address without the token."""
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(self._cookie_name, self._access.cookie, max_age=COOKIE_S, httponly=True, samesite="Strict")
        return response

    async def _send_file(self, request: web.Request) -> web.StreamResponse:
        file = self._files[request.path]
        headers = {"ETag": file.etag, "Cache-Control": "no-cache"}
        if request.headers.get("If-None-Match") == file.etag:
            return web.Response(status=304, headers=headers)
        return web.Response(body=file.body, content_type=file.media_type, charset="utf-8", headers=headers)

    async def _stream_events(self, request: web.Request) -> web.StreamResponse:
        """Stream all present texts, then changes, until either side closes."""
        response = web.StreamResponse(
            headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        )
        with self._latest.reading() as reader, self._streaming(reader, request):
            await response.prepare(request)
            await response.write(b"retry: 1000\n\n")
            while not reader.closed:
                text = await reader.next(PING_S)
                try:
                    async with asyncio.timeout(WRITE_S):
                        await response.write(f"data: {text or '{}'}\n\n".encode())
                except (TimeoutError, ConnectionError):
                    break
        return response

    @contextlib.contextmanager
    def _streaming(self, reader: Reader, request: web.Request) -> Iterator[None]:
        """Register a stream within the context; close another one if there are too many."""
        if len(self._streams) >= MAX_STREAMS:
            self._close_stream(request.remote)
        self._streams[reader] = _Stream(request.remote, request.transport)
        try:
            yield
        finally:
            self._streams.pop(reader, None)

    def _close_stream(self, newcomer: str | None) -> None:
        """Close the oldest stream of the address with most streams; in a tie, of the new stream's address.

        Args:
            newcomer: Address of the client that opens a stream.
        """
        counts = Counter(stream.address for stream in self._streams.values())
        busiest = max(counts, key=lambda address: (counts[address], address == newcomer))
        reader = next(reader for reader, stream in self._streams.items() if stream.address == busiest)
        transport = self._streams.pop(reader).transport
        reader.close()
        if transport:
            transport.abort()  # its reader may be waiting for a client that reads nothing


async def _set_security_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
    response.headers.pop("Server", None)


def _load_file(file: File) -> _LoadedFile:
    body = file.path.read_bytes()
    return _LoadedFile(body, file.media_type, f'"{hashlib.sha256(body).hexdigest()[:16]}"')
