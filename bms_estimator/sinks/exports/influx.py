"""The InfluxDB sink: line protocol over HTTP, in batches.

``publish`` puts lines in a queue; a task takes them from there to a thread that waits for the server. The loop never waits.
"""

import asyncio
import base64
import contextlib
import http.client
import ssl
import urllib.error
import urllib.parse
import urllib.request
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads import Snapshot
from bms_estimator.process.backoff import FIRST_DELAY_S, Backoff
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.process.systemd import credential
from bms_estimator.settings.exports import InfluxSettings
from bms_estimator.sinks.exports.line_protocol import lines

MAX_WAITING = 10_000
"""Lines that wait for a server that is away, hours of states at one a second; beyond it the oldest is dropped."""
BATCH = 1000
"""Lines in one request, a megabyte at most."""
ANSWER_S = 10.0
"""Timeout of a server response [s]."""
CLOSING_S = 3.0
"""Timeout of the last request [s]."""
NEVER = (400, 413, 422)
"""Answers to what will never be taken: the lines are given up. All others may pass."""
MAX_SHOWN = 200
"""Maximum length of a response in the log [characters]."""

log = structlog.get_logger(__name__)


class RefusedError(Exception):
    """The server's no, in words."""

    def __init__(self, why: str, *, for_now: bool) -> None:
        super().__init__(why)
        self.for_now = for_now


class Target(NamedTuple):
    """Destination of the lines, with all files read."""

    url: str
    headers: dict[str, str]
    context: ssl.SSLContext | None


class InfluxSink:
    """Writes states and alarms of one pack.

    Args:
        settings: The server.
        first_delay_s: Delay before a server that is away is retried; it grows as in ``Backoff`` [s].

    Raises:
        UserError: A file of ``settings`` cannot be used.
    """

    def __init__(self, settings: InfluxSettings, *, first_delay_s: float = FIRST_DELAY_S) -> None:
        target(settings)  # unusable settings are reported at start
        self._settings = settings
        self._pauses = Backoff(first_delay_s)
        self._waiting: deque[str] = deque()
        self._batch: list[str] = []  # on its way
        self._before: Snapshot | None = None
        self._full, self._closing = asyncio.Event(), asyncio.Event()
        self._said = ""
        self._thread = DiskThread("influx")
        self._task: asyncio.Task[None] | None = None
        self.dropped = 0
        """Lines that found no room, or that the server will never take."""

    @property
    def waiting(self) -> int:
        """Lines that the server has not taken yet."""
        return len(self._waiting) + len(self._batch)

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._waiting.extend(lines(self._before, snapshot))
        self._before = snapshot
        while len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1
        if len(self._waiting) >= BATCH:
            self._full.set()

    async def __aenter__(self) -> Self:
        """Start."""
        self._task = asyncio.create_task(self._run(), name="influx")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write what waits, in a bounded time."""
        if self._task is None:
            return
        self._closing.set()
        self._full.set()
        done, _ = await asyncio.wait([self._task], timeout=CLOSING_S)
        if not done:
            self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        """Write queued points every ``every_s``, sooner when a batch is full.

        After a failure wait longer each time.
        """
        delay_s = self._settings.every_s
        while True:
            await self._wait(self._closing if self._said else self._full, delay_s)
            self._full.clear()
            well = await self._write()
            if self._closing.is_set():
                return
            delay_s = self._settings.every_s if well else self._pauses.next_s()

    async def _wait(self, event: asyncio.Event, delay_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(delay_s):
                await event.wait()

    async def _write(self) -> bool:
        """Batch after batch until nothing waits; False: the server is to be tried again."""
        loop = asyncio.get_running_loop()
        while self.waiting:
            while self._waiting and len(self._batch) < BATCH:
                self._batch.append(self._waiting.popleft())
            try:
                await loop.run_in_executor(self._thread, partial(_post, self._settings, "\n".join(self._batch)))
            except RefusedError as error:
                self._log(str(error))
                if error.for_now:
                    return False
                self.dropped += len(self._batch)
            else:
                self._well()
            self._batch = []
        return True

    def _log(self, why: str) -> None:
        """Log a reason, once."""
        if why != self._said:
            self._said = why
            log.warning("influxdb takes nothing", url=self._settings.url, reason=why, lines_waiting=self.waiting)

    def _well(self) -> None:
        if self._said:
            log.info("influxdb takes lines again", url=self._settings.url, lines_lost=self.dropped)
            self._said = ""
        self._pauses.reset()


def target(settings: InfluxSettings) -> Target:
    """Return the destination of the lines; files are reloaded each time, so that they can be replaced.

    Raises:
        UserError: A file cannot be used.
    """
    if settings.bucket:
        query = {"bucket": settings.bucket, "org": settings.org or "", "precision": "ms"}
        url, authorization = "/api/v2/write", _token(settings)
    else:
        query = {"db": settings.database, "precision": "ms"}
        url, authorization = "/write", _basic(settings)
    context = None
    if settings.url.startswith("https:"):
        try:
            context = ssl.create_default_context(cafile=settings.ca_file)
        except OSError as error:  # ssl.SSLError is one
            raise UserError(f"influx.ca_file = {settings.ca_file}: no certificates can be read: {error}") from None
    headers = {"Content-Type": "text/plain; charset=utf-8"} | authorization
    return Target(f"{settings.url.rstrip('/')}{url}?{urllib.parse.urlencode(query)}", headers, context)


def _token(settings: InfluxSettings) -> dict[str, str]:
    if settings.token_file is None:
        return {}
    token = _secret("token_file", settings.token_file)
    if not token.isascii():
        raise UserError(f"influx.token_file = {settings.token_file}: must hold ASCII: no header can hold the rest")
    return {"Authorization": f"Token {token}"}


def _basic(settings: InfluxSettings) -> dict[str, str]:
    if settings.username is None:
        return {}
    password = _secret("password_file", settings.password_file) if settings.password_file else ""
    packed = base64.b64encode(f"{settings.username}:{password}".encode()).decode()
    return {"Authorization": f"Basic {packed}"}


def _secret(key: str, path: Path) -> str:
    """Read the single line of a file.

    Raises:
        UserError: It cannot be read, or is no line of text.
    """
    try:
        secret = credential(path).read_text(encoding="utf-8").strip()
    except OSError as error:
        raise UserError(f"influx.{key} = {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:  # whose text contains the bytes
        raise UserError(f"influx.{key} = {path}: cannot be read: not UTF-8 text") from None
    if not secret.isprintable():
        raise UserError(f"influx.{key} = {path}: must hold one line of text")
    return secret


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirected POST would become a GET, which writes nothing and succeeds."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _post(settings: InfluxSettings, body: str) -> None:
    """Write lines.

    Raises:
        RefusedError: The server has not taken them.
    """
    try:
        url, headers, context = target(settings)
        request = urllib.request.Request(url, body.encode(), headers, method="POST")  # noqa: S310 - http or https, as the settings check
        opener = urllib.request.build_opener(_NoRedirect, urllib.request.HTTPSHandler(context=context))
        with opener.open(request, timeout=ANSWER_S):
            return
    except urllib.error.HTTPError as error:
        why = f"{error.code} {error.reason}: {_shown(_answer(error))}"
        raise RefusedError(why, for_now=error.code not in NEVER) from None
    except urllib.error.URLError as error:
        raise RefusedError(str(error.reason), for_now=True) from None
    except (OSError, http.client.HTTPException, UnicodeError, UserError) as error:  # Unicode: of a host that cannot be
        raise RefusedError(str(error) or type(error).__name__, for_now=True) from None


def _answer(error: urllib.error.HTTPError) -> bytes:
    """Return the start of the server's response; empty without one."""
    try:
        with error:
            return error.read(MAX_SHOWN * 4)
    except (OSError, http.client.HTTPException):
        return b""


def _shown(answer: bytes) -> str:
    """Return the part of a response to log."""
    return "".join(c for c in answer.decode(errors="replace") if c.isprintable())[:MAX_SHOWN]
