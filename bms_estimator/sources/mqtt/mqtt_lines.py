"""``kind = "mqtt"``: readings that another program publishes to an MQTT broker."""

import asyncio
import itertools
import math
import secrets
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping

import structlog

from bms_estimator.model.clock import since_boot
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.connection import (
    BrokerConnectionError,
    Connect,
    Connection,
    ConnectOptions,
    Message,
    ReceivedMessage,
    brokers,
    check,
)
from bms_estimator.mqtt.reconnect_loop import BrokerConnector
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.settings.connections import BrokerSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.mqtt import MqttSource
from bms_estimator.sources.mqtt.sample_assembler import SampleAssembler
from bms_estimator.sources.source import LineProducer, SourceUnavailableError

MAX_QUEUED_MESSAGES = 2000
"""Maximum number of unread messages. A broker sends all retained messages of a wildcard at once."""
MAX_BYTES = 65_536
"""Maximum size of a received message [bytes]."""

log = structlog.get_logger(__name__)


class MqttProducer(LineProducer):
    """Line producer that subscribes, polls the publisher if configured, and assembles samples.

    Args:
        settings: Topics and paths.
        mqtt: URLs and credentials of the brokers.
        connect: Connects to a broker; None: over TCP.
        monotonic: Monotonic clock [s].

    Raises:
        UserError: A URL or a file in ``mqtt`` is not valid.
    """

    def __init__(
        self,
        settings: MqttSource,
        mqtt: BrokerSettings,
        *,
        connect: Connect | None = None,
        monotonic: Callable[[], float] = since_boot,
    ) -> None:
        check(mqtt)
        self._settings, self._monotonic = settings, monotonic
        self._assembler = SampleAssembler(settings)
        configured = brokers(mqtt)
        self._broker, self._brokers = configured[0], itertools.cycle(configured)
        self._connect = connect or BrokerConnector(mqtt)
        self._logged_quantities = set[str]()
        self._lost_messages: Counter[str] = Counter({"too_long": 0, "overflow": 0})
        self._options = ConnectOptions(
            f"bms-source-{secrets.token_hex(4)}",
            will=None,
            on_message_lost=self._count_lost,
            max_waiting=MAX_QUEUED_MESSAGES,
            max_bytes=MAX_BYTES,
        )

    @property
    def name(self) -> str:
        """Topics and broker of the source."""
        return f"{self._settings.short_description}, {self._broker.url}"

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the assembler, and of messages that were too long or arrived too fast."""
        return {**self._assembler.counters, **self._lost_messages}

    @property
    def fault(self) -> str | None:
        """Fault of the assembler. It is read only while no samples arrive."""
        return self._assembler.fault or self._assembler.silence_reason

    async def iter_lines(self) -> AsyncGenerator[bytes, None]:
        """Yield a line for each complete sample. Each call tries the next broker.

        Raises:
            SourceUnavailableError: The broker cannot be reached, its connection was lost, or it denies the subscription.
        """
        self._broker = next(self._brokers)
        try:
            async with self._connect(self._broker, self._options) as connection:
                # without retain-as-published, live messages arrive unmarked even if their publisher retains them
                rejections = await connection.subscribe(requests=None, others=self._assembler.topics)
                for topic, reason in rejections.items():
                    raise SourceUnavailableError(f"not allowed to read {topic}: {reason}")
                yield CONNECTED
                async for line in self._lines(connection):
                    yield line
        except BrokerConnectionError as error:
            raise SourceUnavailableError(f"no connection to this broker: {error}") from None

    async def _lines(self, connection: Connection) -> AsyncGenerator[bytes, None]:
        """Yield the lines of a connection; raises ``BrokerConnectionError`` when it is lost."""
        poll_messages = self._settings.ask  # payloads by topic
        receiving: asyncio.Future[ReceivedMessage] | None = None
        poll_sent_s = -math.inf
        try:
            while True:
                now_s = self._monotonic()
                if poll_messages and now_s - poll_sent_s >= self._settings.ask_s:
                    poll_sent_s = now_s
                    await self._poll(connection)
                receiving = receiving or asyncio.ensure_future(connection.receive())
                await asyncio.wait({receiving}, timeout=self._wait_s(now_s, poll_sent_s))
                if receiving.done():
                    message, receiving = receiving.result(), None
                    self._assembler.add_message(
                        message.topic, message.payload, self._monotonic(), retained=message.retain
                    )
                    self.first_invalid = self._assembler.first_faults.get("no_number", "")
                    self._log_conflict()
                    self._log_faults()
                if line := self._assembler.line(self._monotonic()):
                    yield line
        finally:
            if receiving is not None:
                receiving.cancel()
                await asyncio.gather(receiving, return_exceptions=True)

    def _wait_s(self, now_s: float, poll_sent_s: float) -> float | None:
        """Return the time to wait for a message [s]; None without limit."""
        poll_due_s = max(poll_sent_s + self._settings.ask_s - now_s, 0.0) if self._settings.ask else None
        return min((s for s in (poll_due_s, self._assembler.wait_s(now_s)) if s is not None), default=None)

    async def _poll(self, connection: Connection) -> None:
        """Publish the messages that make the publisher report its values."""
        for topic, payload in self._settings.ask.items():
            message = Message(self._settings.substitute(topic), payload.encode(), qos=0, retain=False)
            refusal = await connection.publish(message)
            if refusal is not None:
                raise SourceUnavailableError(f"not allowed to write {message.topic}: {refusal.reason}")

    def _log_conflict(self) -> None:
        """Log the beginning and the end of a conflict between two publishers, and update its description."""
        values = self._assembler.conflict
        if bool(values) == bool(self.conflict):
            return
        self.conflict = values and f"two publishers write the same topic ({values}); stop one of them"
        if values:
            log.warning("two publishers write the same topic; stop one of them", values=values)
        else:
            log.info("one publisher writes the topic again")

    def _log_faults(self) -> None:
        """Log the first message without a value of each quantity. It may be normal, for example without a temperature sensor."""
        for quantity in self._assembler.faults.keys() - self._logged_quantities:
            self._logged_quantities.add(quantity)
            log.info("a message has no value; not logged again", reason=self._assembler.faults[quantity])

    def _count_lost(self, kind: str, _topic: str) -> None:
        self._lost_messages[kind] += 1


def producer(settings: Settings) -> MqttProducer:
    """Make the line producer of ``[source]``.

    Raises:
        UserError: No broker is configured, or its URL or credentials are not valid.
    """
    source = settings.source
    assert isinstance(source, MqttSource)  # noqa: S101 - KINDS maps kind = "mqtt" to MqttSource
    if source.broker is not None:
        return MqttProducer(source, source.broker)
    if settings.mqtt is None:
        raise UserError("source.url: missing, and there is no section [mqtt] with a broker to use instead")
    return MqttProducer(source, settings.mqtt)
