"""The MQTT sink: a connection to a broker that may come and go.

``publish`` puts what must reach the broker in the outbox, and the snapshot in a slot for one; a task takes them from
there when the broker does. The loop never waits. What is said stands in ``messages``, what may be asked in ``requests``.
"""

import asyncio
import contextlib
import math
import random
import secrets
import socket
import ssl
from collections.abc import Iterable
from functools import partial
from typing import Any, Self
from urllib.parse import urlsplit

import aiomqtt
import structlog
from aiomqtt import ProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Snapshot
from bms_estimator.model.settings import MqttSettings
from bms_estimator.sinks import Delivery
from bms_estimator.sinks.credential import credential
from bms_estimator.sinks.home_assistant import BIRTH_TOPIC
from bms_estimator.sinks.messages import AVAILABILITY, SENSOR_AVAILABILITY, Message, Messages, Sent
from bms_estimator.sinks.requests import MOST_SHOWN, Requests
from bms_estimator.store.outbox import Outbox

FIRST_DELAY_S = 5.0
"""Before the first attempt to reach a lost broker again; doubles with each [s]."""
LONGEST_DELAY_S = 30.0
"""A broker in the house is back before long [s]."""
BIRTH_DELAY_S = 2.0
"""Home Assistant says it is online some time before it listens [s]."""
CORRECTION_S = 5.0
"""An availability that somebody else wrote is put right no more often than this [s]."""
BURST_S = 60.0
"""Corrections closer than this are one burst, of which one line is logged [s]."""
ECHO_S = 10.0
"""A broker that has not given back ``online`` by then denies it [s]."""
KEEPALIVE_S = 20
"""A broker that lost us without a word publishes the will after one and a half times this [s]."""
CLOSING_S = 3.0
"""How long the last messages may take [s]."""
BATCH = 20
"""States and events sent between two looks at what else there is to say."""
PORTS = {"mqtt": 1883, "mqtts": 8883}
NO_DELAY = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
"""Small messages go at once."""
MOST_WAITING = 100
"""Messages that wait to be read; more are lost."""
MOST_BYTES = 16_384
"""Nothing that comes is longer: an MQTT 5 broker keeps it back, what an older one hands on is thrown away."""
UNSUPPORTED_VERSION = 132
"""Reason code of a broker that does not know MQTT 5."""

log = structlog.get_logger(__name__)


class MqttSink:
    """Publishes snapshots of one pack and answers requests.

    Args:
        settings: The broker.
        device: Name of the pack in the topics.
        requests: Answers requests.
        delivery: Where it is counted what became of what was sent.
        outbox: What must reach the broker.
        sample_period_s: Between two samples, where that may be longer than the publish period [s].
        first_delay_s: Before the first attempt to reach a lost broker again [s].
        birth_delay_s: From Home Assistant's birth message to the retained messages [s].
        echo_s: Until a broker has given back ``online`` [s].

    Raises:
        UserError: The URL, the password file or the certificates cannot be used.
    """

    def __init__(
        self,
        settings: MqttSettings,
        device: str,
        requests: Requests,
        delivery: Delivery,
        outbox: Outbox,
        *,
        sample_period_s: float = 0.0,
        first_delay_s: float = FIRST_DELAY_S,
        birth_delay_s: float = BIRTH_DELAY_S,
        echo_s: float = ECHO_S,
    ) -> None:
        self._url, self._connection = settings.url, broker_arguments(settings)
        self._requests, self._delivery, self._outbox = requests, delivery, outbox
        self._first_delay_s, self._birth_delay_s, self._echo_s = first_delay_s, birth_delay_s, echo_s
        self._messages = Messages(settings.base_topic, device, sample_period_s)
        # The same at each connection: the broker ends an older one that it still holds, and its will comes first.
        self._identifier = f"bms-{device}-{secrets.token_hex(4)}"
        self._slot: Snapshot | None = None
        self._before: Snapshot | None = None  # the last one that was taken
        self._sent = Sent()  # only the sending task sets it
        self._again = True  # the broker may hold nothing: send all of it
        self._forged = False  # somebody else wrote an availability of ours
        self._corrected_s = -math.inf
        self._echoed = asyncio.Event()
        self._delay_s = first_delay_s
        self._wake = asyncio.Event()
        self._closing = False
        self._task: asyncio.Task[None] | None = None

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once."""
        if self._task is not None and self._task.done():
            self._task.result()  # only a fault of ours ends it: let it be seen
        for message in self._messages.kept(self._before, snapshot):
            self._outbox.put(message)
        self._count()
        self._slot = self._before = snapshot
        self._wake.set()

    def _count(self) -> None:
        self._delivery.drops, self._delivery.waiting = self._outbox.dropped, self._outbox.waiting

    async def __aenter__(self) -> Self:
        """Start reaching for the broker."""
        self._task = asyncio.create_task(self._stay_connected(), name="mqtt")
        return self

    async def __aexit__(self, *_error: object) -> None:
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
        while not self._closing:
            self._again = True
            try:
                await self._connect()
            except* aiomqtt.MqttError as errors:
                log.warning(
                    "broker not reachable", url=self._url, reason=str(errors.exceptions[0]), retry_s=self._delay_s
                )
            if not self._closing:
                await self._pause(self._delay_s * random.uniform(0.5, 1.0))  # not all its clients at once
                self._delay_s = min(2.0 * self._delay_s, LONGEST_DELAY_S)

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

    async def _connect(self) -> None:
        """Serve by MQTT 5, by 3.1.1 where the broker refuses that or does not know what to say."""
        try:
            await self._serve(ProtocolVersion.V5)
        except aiomqtt.MqttError as error:
            if isinstance(error, aiomqtt.MqttCodeError) and error.rc != UNSUPPORTED_VERSION:
                raise
            await self._serve(ProtocolVersion.V311)

    def _client(self, protocol: ProtocolVersion) -> "_Client":
        limit = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # paho has no types there
        limit.MaximumPacketSize = MOST_BYTES
        return _Client(
            **self._connection,
            protocol=protocol,
            properties=limit if protocol is ProtocolVersion.V5 else None,
            identifier=self._identifier,
            will=aiomqtt.Will(*self._messages.farewell()[-1]),
            keepalive=KEEPALIVE_S,
            max_queued_incoming_messages=MOST_WAITING,
            queue_type=partial(_Inbox, self._requests),  # type: ignore[arg-type]  # it is only called
            socket_options=[NO_DELAY],
        )

    async def _serve(self, protocol: ProtocolVersion) -> None:
        """Send and receive until the connection is lost or the sink closes."""
        async with self._client(protocol) as client:
            log.info("broker connected", url=self._url, protocol=protocol.name)
            self._delay_s = self._first_delay_s
            await self._subscribe(client, protocol)
            self._wake.set()
            self._outbox.connected = True
            try:
                async with asyncio.TaskGroup() as tasks:
                    others = [tasks.create_task(self._receive(client)), tasks.create_task(self._expect_echo())]
                    await self._send(client)
                    for task in others:
                        task.cancel()
            except* aiomqtt.MqttError:
                raise  # the broker publishes the will
            except* Exception:  # a fault of ours: the client parts in good order, which withholds the will
                with contextlib.suppress(aiomqtt.MqttError):
                    await self._publish(client, self._messages.farewell())
                raise
            finally:
                self._outbox.connected = False
                self._outbox.rewind()

    async def _subscribe(self, client: aiomqtt.Client, protocol: ProtocolVersion) -> None:
        """Subscribe, and say what the broker refuses.

        At QoS 0: Mosquitto counts what it keeps back as too long among the messages in flight, where at QoS 1 it stays.
        """
        requests = self._topic("request/+")
        topics = [requests, self._topic(AVAILABILITY), self._topic(SENSOR_AVAILABILITY), BIRTH_TOPIC]
        if protocol is ProtocolVersion.V5:  # a request that is retained must say so, though it comes live
            wanted: Any = [(topic, SubscribeOptions(qos=0, retainAsPublished=topic == requests)) for topic in topics]
        else:
            wanted = [(topic, 0) for topic in topics]
        self._echoed.clear()
        answers = await client.subscribe(wanted)
        self._delivery.refused_topics = []
        for topic, answer in zip(topics, answers, strict=False):
            if isinstance(answer, ReasonCode) and answer.is_failure:
                self._say_refused(topic, "not allowed to read it")

    async def _expect_echo(self) -> None:
        """Find out a broker that denies us without a word, as Mosquitto does with what may not be read."""
        topic = self._topic(AVAILABILITY)
        try:
            async with asyncio.timeout(self._echo_s):
                await self._echoed.wait()
        except TimeoutError:
            if topic in self._delivery.refused_topics:
                return
            self._say_refused(topic, "it does not come back: not allowed to read it, or the broker is slow")
            await self._echoed.wait()
            self._delivery.refused_topics.remove(topic)

    async def _publish(self, client: "_Client", messages: Iterable[Message]) -> None:
        """Publish one after the other; only one task does at a time."""
        for message in messages:
            client.denied = False
            await client.publish(*message)
            if client.denied and message.topic not in self._delivery.refused_topics:
                self._say_refused(message.topic, "not allowed to write it")

    def _say_refused(self, topic: str, why: str) -> None:
        self._delivery.refused_topics.append(topic)
        log.warning("broker refuses a topic; see its access list", topic=topic, reason=why)

    async def _send(self, client: "_Client") -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._again:
                self._again, self._forged, self._sent = False, False, Sent()
                await self._publish(client, self._messages.greeting())
            await self._correct(client)
            snapshot, self._slot = self._slot, None
            if snapshot is not None:
                now_s = asyncio.get_running_loop().time()
                messages, self._sent = self._messages.due(self._sent, snapshot, now_s)
                await self._publish(client, messages)
            await self._send_kept(client)
            if self._closing:
                await self._publish(client, self._messages.farewell())
                return
            if self._outbox.waiting:
                self._wake.set()

    async def _send_kept(self, client: "_Client") -> None:
        """Send some of what waits in the outbox."""
        if self._outbox.waiting:
            for number, message in await self._outbox.take(BATCH):
                await self._publish(client, [message])
                self._outbox.sent(number)
        self._count()

    async def _correct(self, client: "_Client") -> None:
        """Put the availabilities right, if it is time.

        Counted when the broker has taken it: one that ends says our will, and takes none.
        """
        now_s = asyncio.get_running_loop().time()
        since_s = now_s - self._corrected_s
        if not self._forged or since_s < CORRECTION_S:
            return
        self._forged, self._corrected_s = False, now_s
        await self._publish(client, self._messages.availability(self._sent))
        self._delivery.corrections += 1
        if since_s > BURST_S:
            log.warning(
                "somebody else wrote an availability of this pack: put right", so_far=self._delivery.corrections
            )

    async def _receive(self, client: aiomqtt.Client) -> None:
        """Answer requests, hear Home Assistant's birth, watch over the availabilities."""
        async for message in client.messages:
            topic = message.topic.value
            if topic == BIRTH_TOPIC:
                if message.payload == b"online" and not message.retain:
                    asyncio.get_running_loop().call_later(self._birth_delay_s, self._say_again)
            elif topic in (self._topic(AVAILABILITY), self._topic(SENSOR_AVAILABILITY)):
                if not message.retain:  # what the broker kept from earlier is not news
                    self._compare(topic, message.payload)
            else:
                await self._answer(client, topic.rsplit("/", 1)[-1], message)

    async def _answer(self, client: aiomqtt.Client, name: str, message: aiomqtt.Message) -> None:
        if message.retain:  # it would be granted again with each connection
            self._requests.refuse("retained", name[:MOST_SHOWN])
            return
        response = await self._requests.respond(name, message.payload)
        if response is not None:  # so the name is one of ours
            # not at QoS 1: in a flood the broker's word that it has it comes late, and who waits for that reads nothing
            await client.publish(self._topic(f"response/{name}"), response, qos=0)

    def _compare(self, topic: str, payload: bytes) -> None:
        """An availability has come: given back, or somebody else's."""
        right = {own.topic: own.payload for own in self._messages.availability(self._sent)}
        if right.get(topic, payload) == payload:
            self._echoed.set()
        elif not self._forged:
            self._forged = True
            loop = asyncio.get_running_loop()
            loop.call_at(max(self._corrected_s + CORRECTION_S, loop.time()), self._wake.set)

    def _say_again(self) -> None:
        """Send all retained messages again with the next snapshot."""
        self._again = True

    def _topic(self, name: str) -> str:
        return f"{self._messages.root}/{name}"


class _Client(aiomqtt.Client):
    """Hears what the broker answers to a message of QoS 1, which MQTT 5 has; the base throws it away."""

    denied = False
    """Set when a message was refused."""

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:
        self.denied |= reason_code.is_failure
        super()._on_publish(client, userdata, mid, reason_code, properties)


class _Inbox(asyncio.Queue[aiomqtt.Message]):
    """What waits to be read; bounded in bytes, too, and without a log line for each message that is lost.

    Args:
        requests: What is lost is counted there.
        maxsize: Messages.
    """

    def __init__(self, requests: Requests, maxsize: int) -> None:
        super().__init__(maxsize)
        self._requests = requests

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Take a message, or count that it is lost."""
        topic = item.topic.value
        if len(topic) + len(item.payload) > MOST_BYTES:
            self._requests.refuse("too_long", topic[:MOST_SHOWN])
        elif self.full():
            self._requests.refuse("overflow", topic[:MOST_SHOWN])
        else:
            super().put_nowait(item)


def broker_arguments(settings: MqttSettings) -> dict[str, Any]:
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
