"""The MQTT sink: topics under ``bms/<device>/``, with a broker that may come and go.

``publish`` puts a snapshot in a slot for one; a task takes it from there when the broker does. The loop
never waits, and what the broker could not take in time is counted.
"""

import asyncio
import contextlib
import json
import math
import secrets
import socket
import ssl
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import aiomqtt
import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Estimate, Health, Info, ParameterReport, Report, Snapshot
from bms_estimator.model.settings import MqttSettings
from bms_estimator.sinks import Answer
from bms_estimator.sinks.credential import credential
from bms_estimator.sinks.home_assistant import BIRTH_TOPIC, discovery, discovery_topic

FIRST_DELAY_S = 5.0
"""Before the first attempt to reach a lost broker again; doubles with each [s]."""
LONGEST_DELAY_S = 300.0
BIRTH_DELAY_S = 2.0
"""Home Assistant says it is online some time before it listens [s]."""
KEEPALIVE_S = 20
"""A broker that lost us without a word publishes the will after one and a half times this [s]."""
CLOSING_S = 3.0
"""How long the last messages may take [s]."""
PORTS = {"mqtt": 1883, "mqtts": 8883}
NO_DELAY = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
"""Small messages go at once."""
MOST_REQUESTS = 100
"""Requests waiting beyond this are lost."""

log = structlog.get_logger(__name__)


class MqttSink:
    """Publishes snapshots of one pack and answers requests.

    Args:
        settings: The broker.
        device: Name of the pack in the topics.
        answer: Answers requests.
        sample_period_s: Between two samples, where that may be longer than the publish period [s].
        first_delay_s: Before the first attempt to reach a lost broker again [s].
        birth_delay_s: From Home Assistant's birth message to the retained messages [s].

    Raises:
        UserError: The URL, the password file or the certificates cannot be used.
    """

    def __init__(
        self,
        settings: MqttSettings,
        device: str,
        answer: Answer,
        *,
        sample_period_s: float = 0.0,
        first_delay_s: float = FIRST_DELAY_S,
        birth_delay_s: float = BIRTH_DELAY_S,
    ) -> None:
        self._settings, self._device, self._answer = settings, device, answer
        self._sample_period_s = sample_period_s
        self._first_delay_s, self._birth_delay_s = first_delay_s, birth_delay_s
        self._root = f"{settings.base_topic}/{device}"
        self._connection = _connection(settings)
        self._slot: Snapshot | None = None
        self._sent: Snapshot | None = None  # what the broker holds; only the sending task sets it
        self._again = True  # the broker may hold nothing: send all of it
        self._wake = asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None
        self.drops = 0
        """Snapshots replaced before the broker could take them."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once."""
        if self._task is not None and self._task.done():
            self._task.result()  # only a fault of ours ends it: let it be seen
        if self._slot is not None and self._slot.estimate is not None:
            self.drops += 1
        self._slot = snapshot
        self._wake.set()

    async def __aenter__(self) -> Self:
        """Start reaching for the broker."""
        self._task = asyncio.create_task(self._stay_connected(), name="mqtt")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Publish what is pending and ``offline``, then part from the broker."""
        if self._task is None:
            return
        self._closing = True
        self._wake.set()
        done, _ = await asyncio.wait([self._task], timeout=CLOSING_S)
        if not done:
            self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def _stay_connected(self) -> None:
        """Connect, serve, and again after a pause that doubles."""
        delay_s = self._first_delay_s
        while not self._closing:
            self._again = True
            try:
                async with self._client() as client:
                    log.info("broker connected", url=self._settings.url)
                    delay_s = self._first_delay_s
                    await self._serve(client)
            except* aiomqtt.MqttError as errors:
                log.warning(
                    "broker not reachable", url=self._settings.url, reason=str(errors.exceptions[0]), retry_s=delay_s
                )
            if not self._closing:
                await self._pause(delay_s)
                delay_s = min(2.0 * delay_s, LONGEST_DELAY_S)

    async def _pause(self, delay_s: float) -> None:
        """Sleep, but not through the end."""
        until = asyncio.get_running_loop().time() + delay_s
        while not self._closing:
            self._wake.clear()
            try:
                async with asyncio.timeout_at(until):
                    await self._wake.wait()
            except TimeoutError:
                return

    def _client(self) -> aiomqtt.Client:
        return aiomqtt.Client(
            **self._connection,
            identifier=f"bms-{self._device}-{secrets.token_hex(4)}",
            will=aiomqtt.Will(f"{self._root}/availability", b"offline", qos=1, retain=True),
            keepalive=KEEPALIVE_S,
            max_queued_incoming_messages=MOST_REQUESTS,
            socket_options=[NO_DELAY],
        )

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Send and receive until the connection is lost or the sink closes."""
        await client.subscribe([(f"{self._root}/request/+", 1), (BIRTH_TOPIC, 1)])
        self._wake.set()
        try:
            async with asyncio.TaskGroup() as tasks:
                receiving = tasks.create_task(self._receive(client))
                await self._send(client)
                receiving.cancel()
        except* aiomqtt.MqttError:
            raise  # the broker publishes the will
        except* Exception:  # a fault of ours: the client parts in good order, which withholds the will
            with contextlib.suppress(aiomqtt.MqttError):
                await self._say_offline(client)
            raise

    async def _send(self, client: aiomqtt.Client) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._again:
                self._again, self._sent = False, None
                await self._retain(client, "availability", b"online")
                await self._retain(client, "schema", _json(schema()))
            snapshot, self._slot = self._slot, None
            if snapshot is not None:
                await self._send_snapshot(client, snapshot)
            if self._closing:
                await self._say_offline(client)
                return

    async def _say_offline(self, client: aiomqtt.Client) -> None:
        await self._retain(client, "sensor/availability", b"offline")
        await self._retain(client, "availability", b"offline")

    async def _send_snapshot(self, client: aiomqtt.Client, snapshot: Snapshot) -> None:
        """State first, for it is in a hurry; of the rest, what has changed since the last time."""
        estimate, parameters, health, info = snapshot
        if estimate is not None:
            await client.publish(f"{self._root}/state", estimate.model_dump_json(), qos=0)
        sent, self._sent = self._sent, snapshot
        known = bool(parameters.elements)  # not before the first sample, and Home Assistant's templates need them
        if known and (sent is None or sent.parameters is not parameters):
            await client.publish(f"{self._root}/parameters", parameters.model_dump_json(), qos=0)
        if sent is None or sent.health.sensor_online != health.sensor_online:
            await self._retain(client, "sensor/availability", b"online" if health.sensor_online else b"offline")
        if sent is None or sent.health is not health:
            counted = health.model_copy(update={"publish_drops": self.drops})
            await self._retain(client, "health", counted.model_dump_json().encode())
        if sent is None or sent.info != info:
            await self._retain(client, "info", info.model_dump_json().encode())
            found = _json(discovery(info, self._root, self._sample_period_s))
            await client.publish(discovery_topic(self._device), found, qos=1, retain=True)

    async def _retain(self, client: aiomqtt.Client, topic: str, payload: bytes) -> None:
        await client.publish(f"{self._root}/{topic}", payload, qos=1, retain=True)

    async def _receive(self, client: aiomqtt.Client) -> None:
        """Answer requests; after Home Assistant's birth say everything again."""
        async for message in client.messages:
            if message.topic.matches(BIRTH_TOPIC):
                if message.payload == b"online" and not message.retain:
                    asyncio.get_running_loop().call_later(self._birth_delay_s, self._say_again)
            elif not message.retain:  # a retained request would be granted again with each connection
                name = message.topic.value.rsplit("/", 1)[-1]
                response = await _respond(self._answer, name, message.payload)
                await client.publish(f"{self._root}/response/{name}", _json(response), qos=1)

    def _say_again(self) -> None:
        """Send all retained messages again with the next snapshot."""
        self._again = True


def schema() -> dict[str, Any]:
    """JSON schema of each topic's payload."""
    topics: dict[str, type[Report]] = {"state": Estimate, "parameters": ParameterReport, "health": Health, "info": Info}
    return {topic: model.model_json_schema() for topic, model in topics.items()}


async def _respond(answer: Answer, name: str, payload: object) -> dict[str, Any]:
    """The response to a request: status, data, error, transaction."""
    transaction = None
    try:
        arguments = _arguments(payload)
        transaction = _transaction(arguments)
        data = await answer(name, arguments)
    except UserError as error:
        return {"status": "error", "data": None, "error": str(error), "transaction": transaction}
    return {"status": "ok", "data": data, "error": None, "transaction": transaction}


def _arguments(payload: object) -> Mapping[str, Any]:
    """A request's payload: a JSON object of finite numbers, or nothing.

    Raises:
        UserError: It is something else.
    """
    if not payload:
        return {}
    try:
        text = payload if isinstance(payload, str | bytes) else str(payload)
        arguments = json.loads(text, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError):
        raise UserError("a request's payload must be a JSON object or empty") from None
    if not isinstance(arguments, dict):
        raise UserError("a request's payload must be a JSON object or empty")
    return arguments


def _finite(token: str) -> float:
    """A number of a request; Python's JSON knows NaN, and takes 1e999 for infinity.

    Raises:
        UserError: It is not finite.
    """
    number = float(token)
    if not math.isfinite(number):
        raise UserError(f"{token}: numbers of a request must be finite")
    return number


def _transaction(arguments: Mapping[str, Any]) -> str | int | None:
    """What the response repeats, so that who asked knows it again.

    Raises:
        UserError: It is neither a string nor an integer.
    """
    transaction = arguments.get("transaction")
    if transaction is not None and (isinstance(transaction, bool) or not isinstance(transaction, str | int)):
        raise UserError("transaction: must be a string or an integer")
    return transaction


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def _connection(settings: MqttSettings) -> dict[str, Any]:
    """Arguments of the client that reach the broker.

    Raises:
        UserError: The URL, the password file or the certificates cannot be used.
    """
    try:
        url = urlsplit(settings.url)
        host, port = url.hostname, url.port or PORTS[url.scheme]
        (host or "").encode("idna")  # as the resolver will
    except ValueError as error:  # UnicodeError is one
        raise UserError(f"mqtt.url = {settings.url}: {error}") from None
    if not host or url.username is not None:
        raise UserError(f"mqtt.url = {settings.url}: must be mqtt://host:port; the name goes to mqtt.username")
    connection: dict[str, Any] = {"hostname": host, "port": port, "username": settings.username}
    if settings.password_file is not None:
        try:
            connection["password"] = credential(settings.password_file).read_text(encoding="utf-8").rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"mqtt.password_file = {settings.password_file}: cannot be read: {error}") from None
    if url.scheme == "mqtts":
        try:
            connection["tls_context"] = ssl.create_default_context(cafile=settings.ca_file)
        except OSError as error:  # ssl.SSLError is one
            raise UserError(f"mqtt.ca_file = {settings.ca_file}: no certificates can be read: {error}") from None
    return connection
