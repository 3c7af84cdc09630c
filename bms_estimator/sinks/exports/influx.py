"""InfluxDB sink: line protocol over HTTP, in batches.

``publish`` queues lines. A task sends them in a thread, so that the event loop never waits for the server. The lines have the
names that Telegraf gives the fields of the MQTT payloads.
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
from collections.abc import Iterator, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import structlog

from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Alarm, Snapshot
from bms_estimator.process.runtime import FIRST_DELAY_S, Backoff, finish
from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.process.systemd import credential_path
from bms_estimator.settings.connections import InfluxSettings

STATE = "bms_state"
"""Name of the measurement of states. The tag ``device`` is the pack."""
ALARM = "bms_alarm"
"""Name of the measurement of alarm changes. The tag ``device`` is the pack."""


def lines(before: Snapshot | None, snapshot: Snapshot) -> list[str]:
    """Return lines of the state, if there is one, and of changed alarms, with times in milliseconds.

    Args:
        before: Previous snapshot; None for the first one.
        snapshot: Snapshot to convert.
    """
    device = snapshot.info.device
    state = [_state(device, snapshot.estimate)] if snapshot.estimate else []
    previous = {alarm.name: alarm for alarm in before.alarms} if before else {}
    changed = [alarm for alarm in snapshot.alarms if previous.get(alarm.name) != alarm]
    return state + [_alarm(device, alarm, snapshot.health.publish_time) for alarm in changed]


def _state(device: str, estimate: Estimate) -> str:
    fields = dict(estimate)
    time = fields.pop("time")
    return f"{STATE},device={device} {','.join(_fields(fields))} {_epoch_ms(time)}"


def _alarm(device: str, alarm: Alarm, time: str) -> str:
    fields = {"active": alarm.active, "watched": alarm.watched, "value": alarm.value, "limit": alarm.limit}
    items = [*_fields(fields), f"text={_quoted(alarm.text)}"]
    return f"{ALARM},device={device},name={alarm.name},severity={alarm.severity} {','.join(items)} {_epoch_ms(time)}"


def _fields(values: Mapping[str, object]) -> Iterator[str]:
    """Yield Booleans and numbers as fields, and list items as fields numbered from 0.

    All numbers become floats, because a field must not change its type.
    """
    for name, value in values.items():
        if isinstance(value, bool):
            yield f"{name}={'true' if value else 'false'}"
        elif isinstance(value, int | float):
            yield f"{name}={float(value)!r}"
        elif isinstance(value, list):
            yield from _fields({f"{name}_{index}": item for index, item in enumerate(value)})


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'


def _epoch_ms(iso: str) -> int:
    return round(datetime.fromisoformat(iso).timestamp() * 1000.0)


MAX_WAITING = 10_000
"""Maximum number of queued lines. With one state a second they last almost three hours; then the oldest is dropped."""
BATCH_LINES = 1000
"""Maximum number of lines in a request of about a megabyte."""
RESPONSE_TIMEOUT_S = 10.0
"""Timeout of a server response [s]."""
SHUTDOWN_TIMEOUT_S = 3.0
"""Timeout of the last request [s]."""
PERMANENT_ERRORS = (400, 413, 422)
"""HTTP status codes for lines that the server will never accept. After any other code the lines are sent again."""
MAX_LOGGED_CHARACTERS = 200
"""Maximum length of a response in the log [characters]."""

log = structlog.get_logger(__name__)


class WriteError(Exception):
    """The lines were not written: the server is unreachable or rejects them, or a file of the settings cannot be read."""

    def __init__(self, reason: str, *, is_retryable: bool) -> None:
        super().__init__(reason)
        self.is_retryable = is_retryable


class Target(NamedTuple):
    """Destination of the lines, with credentials read from their files."""

    url: str
    headers: dict[str, str]
    context: ssl.SSLContext | None


class InfluxSink:
    """Sink that writes states and alarms of one pack to a server.

    Args:
        settings: Settings of the server.
        first_delay_s: Delay before an unavailable server is retried [s]; it grows as in ``Backoff``.

    Raises:
        UserError: A file of ``settings`` cannot be used.
    """

    def __init__(self, settings: InfluxSettings, *, first_delay_s: float = FIRST_DELAY_S) -> None:
        target(settings)  # unusable settings are reported at start
        self._settings = settings
        self._backoff = Backoff(first_delay_s)
        self._queue: deque[str] = deque()
        self._batch: list[str] = []  # lines of the current request
        self._previous: Snapshot | None = None
        self._batch_is_full, self._closing = asyncio.Event(), asyncio.Event()
        self._failure = ""  # reason for the last failed request; empty after a success
        self._thread = DaemonThreadExecutor("influx")
        self._task: asyncio.Task[None] | None = None
        self.dropped = 0
        """Number of lines dropped from a full queue or permanently rejected by the server."""

    @property
    def waiting(self) -> int:
        """Number of lines that the server has not accepted yet."""
        return len(self._queue) + len(self._batch)

    def publish(self, snapshot: Snapshot) -> None:
        """Queue the lines of a snapshot without waiting."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        self._queue.extend(lines(self._previous, snapshot))
        self._previous = snapshot
        while len(self._queue) > MAX_WAITING:
            self._queue.popleft()
            self.dropped += 1
        if len(self._queue) >= BATCH_LINES:
            self._batch_is_full.set()

    async def __aenter__(self) -> Self:
        """Start the sending task."""
        self._task = asyncio.create_task(self._run(), name="influx")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Send the queued lines within ``SHUTDOWN_TIMEOUT_S``."""
        if self._task is None:
            return
        self._closing.set()
        self._batch_is_full.set()
        await finish(self._task, SHUTDOWN_TIMEOUT_S)

    async def _run(self) -> None:
        """Send queued lines every ``every_s``, or sooner if a batch is full.

        After a failure, wait for the backoff delay.
        """
        delay_s = self._settings.every_s
        while True:
            # after a failure, a full batch does not shorten the delay
            await self._wait(self._closing if self._failure else self._batch_is_full, delay_s)
            self._batch_is_full.clear()
            succeeded = await self._write()
            if self._closing.is_set():
                return
            delay_s = self._settings.every_s if succeeded else self._backoff.next_s()

    async def _wait(self, event: asyncio.Event, delay_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(delay_s):
                await event.wait()

    async def _write(self) -> bool:
        """Send batches until the queue is empty. Return False if the server must be retried."""
        loop = asyncio.get_running_loop()
        while self.waiting:
            while self._queue and len(self._batch) < BATCH_LINES:
                self._batch.append(self._queue.popleft())
            try:
                await loop.run_in_executor(self._thread, partial(_post, self._settings, "\n".join(self._batch)))
            except WriteError as error:
                self._log_failure(str(error))
                if error.is_retryable:
                    return False
                self.dropped += len(self._batch)
            else:
                self._record_success()
            self._batch = []
        return True

    def _log_failure(self, reason: str) -> None:
        """Log a reason if it has changed."""
        if reason != self._failure:
            self._failure = reason
            log.warning(
                "lines are not written to influxdb", url=self._settings.url, reason=reason, lines_waiting=self.waiting
            )

    def _record_success(self) -> None:
        if self._failure:
            log.info("lines are written to influxdb again", url=self._settings.url, lines_lost=self.dropped)
            self._failure = ""
        self._backoff.reset()


def target(settings: InfluxSettings) -> Target:
    """Return the destination of the lines. Files are reloaded each time, because they may have been replaced.

    Raises:
        TemporaryError: A file cannot be used, perhaps because it is being replaced.
    """
    if settings.bucket:
        query = {"bucket": settings.bucket, "org": settings.org or "", "precision": "ms"}
        path, authorization = "/api/v2/write", _token_header(settings)
    else:
        query = {"db": settings.database, "precision": "ms"}
        path, authorization = "/write", _basic_header(settings)
    context = None
    if settings.url.startswith("https:"):
        try:
            context = ssl.create_default_context(cafile=settings.ca_file)
        except OSError as error:  # includes ssl.SSLError
            raise TemporaryError(f"influx.ca_file = {settings.ca_file}: no certificates can be read: {error}") from None
    headers = {"Content-Type": "text/plain; charset=utf-8"} | authorization
    return Target(f"{settings.url.rstrip('/')}{path}?{urllib.parse.urlencode(query)}", headers, context)


def _token_header(settings: InfluxSettings) -> dict[str, str]:
    if settings.token_file is None:
        return {}
    token = _secret("token_file", settings.token_file)
    if not token.isascii():
        raise TemporaryError(
            f"influx.token_file = {settings.token_file}: must be ASCII, because it is sent in a header"
        )
    return {"Authorization": f"Token {token}"}


def _basic_header(settings: InfluxSettings) -> dict[str, str]:
    if settings.username is None:
        return {}
    password = _secret("password_file", settings.password_file) if settings.password_file else ""
    encoded = base64.b64encode(f"{settings.username}:{password}".encode()).decode()
    return {"Authorization": f"Basic {encoded}"}


def _secret(key: str, path: Path) -> str:
    """Read the single line of a file.

    Raises:
        TemporaryError: The file cannot be read, or is not one line of text.
    """
    try:
        secret = credential_path(path).read_text(encoding="utf-8").strip()
    except OSError as error:
        raise TemporaryError(f"influx.{key} = {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:  # its text would show bytes of the secret
        raise TemporaryError(f"influx.{key} = {path}: cannot be read: not UTF-8 text") from None
    if not secret.isprintable():
        raise TemporaryError(f"influx.{key} = {path}: must hold one line of text")
    return secret


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Handler that rejects redirects: a redirected POST would become a GET, which succeeds and writes nothing."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _post(settings: InfluxSettings, body: str) -> None:
    """Write lines.

    Raises:
        WriteError: The server has not accepted the lines.
    """
    try:
        url, headers, context = target(settings)
        request = urllib.request.Request(url, body.encode(), headers, method="POST")  # noqa: S310 - http or https, as the settings check
        opener = urllib.request.build_opener(_NoRedirect, urllib.request.HTTPSHandler(context=context))
        with opener.open(request, timeout=RESPONSE_TIMEOUT_S):
            return
    except urllib.error.HTTPError as error:
        reason = f"{error.code} {error.reason}: {_printable(_response_start(error))}"
        raise WriteError(reason, is_retryable=error.code not in PERMANENT_ERRORS) from None
    except urllib.error.URLError as error:
        raise WriteError(str(error.reason), is_retryable=True) from None
    except (OSError, http.client.HTTPException, UnicodeError, UserError) as error:  # UnicodeError: invalid host name
        raise WriteError(str(error) or type(error).__name__, is_retryable=True) from None


def _response_start(error: urllib.error.HTTPError) -> bytes:
    """Return the start of the server's response; empty without one."""
    try:
        with error:
            return error.read(MAX_LOGGED_CHARACTERS * 4)  # a character has at most four bytes
    except (OSError, http.client.HTTPException):
        return b""


def _printable(response: bytes) -> str:
    """Return the printable start of a response, for the log."""
    return "".join(c for c in response.decode(errors="replace") if c.isprintable())[:MAX_LOGGED_CHARACTERS]
