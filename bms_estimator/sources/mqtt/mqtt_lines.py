"""``kind = "mqtt"``: readings that another program publishes."""

import asyncio
import itertools
import secrets
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.broker_config import brokers, check
from bms_estimator.mqtt.connection import BrokerConnectionError, Connect, Connection, ConnectOptions, ReceivedMessage
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.protocol_negotiation import BrokerConnector
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.settings.mqtt_source import MqttSource
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.line_source import LineProducer, SourceUnavailableError
from bms_estimator.sources.mqtt.sample_assembler import SampleAssembler

MAX_WAITING = 2000
"""Maximum number of unread messages: a broker sends all retained messages of a wildcard at once."""
MAX_BYTES = 65_536
"""Maximum size of a battery's message [bytes]."""

log = structlog.get_logger(__name__)


class MqttReports(LineProducer):
    """Subscribes, polls the publisher if necessary, and assembles samples.

    Args:
        settings: Topics and paths.
        mqtt: The brokers, and what opens their doors.
        connect: Makes a connection; over TCP when left out.
        monotonic: Monotonic clock [s].

    Raises:
        UserError: A URL or a file of ``mqtt`` cannot be used.
    """

    def __init__(
        self,
        settings: MqttSource,
        mqtt: MqttSettings,
        *,
        connect: Connect | None = None,
        monotonic: Callable[[], float] = since_boot,
    ) -> None:
        check(mqtt)
        self._settings, self._monotonic = settings, monotonic
        self._assembly = SampleAssembler(settings)
        found = brokers(mqtt)
        self._broker, self._brokers = found[0], itertools.cycle(found)
        self._connect = connect or BrokerConnector(mqtt)
        self._conflicting = False
        self._lost: Counter[str] = Counter({"too_long": 0, "overflow": 0})
        self._hello = ConnectOptions(f"bms-source-{secrets.token_hex(4)}", None, self._lose, MAX_WAITING, MAX_BYTES)

    @property
    def name(self) -> str:
        """Topics and broker of the source."""
        return f"{self._settings.described}, {self._broker.url}"

    @property
    def counters(self) -> Mapping[str, int]:
        """The assembly's; messages that were too long or arrived too fast."""
        return {**self._assembly.counters, **self._lost}

    @property
    def fault(self) -> str | None:
        """Fault of the assembler."""
        return self._assembly.fault

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Lines as samples are complete; each time the next broker is tried.

        Raises:
            SourceUnavailableError: The broker cannot be reached, was lost, or denies the subscription.
        """
        self._broker = next(self._brokers)
        try:
            async with self._connect(self._broker, self._hello) as connection:
                for topic, why in (await connection.subscribe(None, self._assembly.topics)).items():
                    raise SourceUnavailableError(f"not allowed to read {topic}: {why}")
                yield CONNECTED
                async for line in self._lines(connection):
                    yield line
        except BrokerConnectionError as error:
            raise SourceUnavailableError(str(error)) from None

    async def _lines(self, connection: Connection) -> AsyncGenerator[bytes, None]:
        """Yield the lines of a connection; raises ``BrokerConnectionError`` when it is lost."""
        receiving: asyncio.Future[ReceivedMessage] | None = None
        asked_s = -float("inf")
        try:
            while True:
                now_s = self._monotonic()
                if self._settings.ask and now_s - asked_s >= self._settings.ask_s:
                    asked_s = now_s
                    await self._ask(connection)
                receiving = receiving or asyncio.ensure_future(connection.receive())
                await asyncio.wait({receiving}, timeout=self._wait_s(now_s, asked_s))
                if receiving.done():
                    message, receiving = receiving.result(), None
                    self._assembly.take(message.topic, message.payload, self._monotonic(), retained=message.retain)
                    self._log_conflict()
                if line := self._assembly.line(self._monotonic()):
                    yield line
        finally:
            if receiving is not None:
                receiving.cancel()
                await asyncio.gather(receiving, return_exceptions=True)

    def _wait_s(self, now_s: float, asked_s: float) -> float | None:
        """Return the time to wait for a message [s]; None without limit."""
        ask_s = max(asked_s + self._settings.ask_s - now_s, 0.0) if self._settings.ask else None
        return min((s for s in (ask_s, self._assembly.wait_s(now_s)) if s is not None), default=None)

    async def _ask(self, connection: Connection) -> None:
        """Have the publisher speak."""
        for topic, payload in self._settings.ask.items():
            message = Message(self._settings.substitute(topic), payload.encode(), 0, retain=False)
            refusal = await connection.publish(message)
            if refusal is not None:
                raise SourceUnavailableError(f"not allowed to write {message.topic}: {refusal.reason}")

    def _log_conflict(self) -> None:
        """Log the first message of a second publisher, and its end."""
        conflict = self._assembly.conflict
        if bool(conflict) == self._conflicting:
            return
        self._conflicting = bool(conflict)
        if conflict:
            log.warning("two publishers write the same topic; stop one of them", values=conflict)
        else:
            log.info("one publisher writes the topic again")

    def _lose(self, kind: str, _topic: str) -> None:
        self._lost[kind] += 1


def producer(settings: Settings) -> MqttReports:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: There is no broker, or what opens its door cannot be used.
    """
    source = settings.source
    assert isinstance(source, MqttSource)  # noqa: S101 - as KINDS has it
    if source.url is not None:
        told = {"url": source.url, "username": source.username}
        mqtt = MqttSettings(**told, password_file=source.password_file, ca_file=source.ca_file)
        try:
            return MqttReports(source, mqtt)
        except UserError as error:
            raise UserError(str(error).replace("mqtt.", "source.", 1)) from None
    if settings.mqtt is None:
        raise UserError("source.url: missing, and there is no [mqtt] whose broker could be meant")
    return MqttReports(source, settings.mqtt)
