"""MQTT sink: publishes the snapshots of a pack, also over outages of the broker, and answers requests.

``publish`` queues states and events in the outbox and keeps the last snapshot; tasks send both, so that the event loop
never waits for the broker. ``messages`` builds the messages, ``requests`` handles requests, ``mqtt.reconnect_loop``
connects. A monitor detects messages of other clients on the availability topics of the service and of its sensor, and corrects
these topics and those of the alarms.
"""

import asyncio
import contextlib
import math
import secrets
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from typing import Self

import structlog

from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.mqtt.connection import (
    Connect,
    Connection,
    ConnectOptions,
    DeliveryStats,
    Message,
    OnResult,
    ReceivedMessage,
    brokers,
    check,
)
from bms_estimator.mqtt.queue_sender import DeniedTopics, QueueSender
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.process.runtime import FIRST_DELAY_S, finish
from bms_estimator.settings.alarms import ALARMS
from bms_estimator.settings.connections import HomeAssistantSettings, MqttSettings
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY, MessageBuilder, PublishedState
from bms_estimator.sinks.mqtt.requests import MAX_SHOWN, RequestDispatcher
from bms_estimator.store.outbox import Outbox

CORRECTION_S = 5.0
"""Minimum interval between two corrections of an availability that another client wrote [s]."""
BURST_S = 60.0
"""Maximum interval between two corrections of one burst [s]. One line is logged for each burst."""
ECHO_S = 10.0
"""Time after which a broker that has not returned ``online`` counts as denying the topic [s]."""


class AvailabilityMonitor:
    """Compares the availability messages that the broker returns with those that the service has published.

    Args:
        correct_messages: Returns the correct messages. The first message is the availability of the service itself.
        delivery: Statistics in which corrections are counted.
        denied: Denied topics, to which a missing echo is reported.
        wake: Called when ``correct`` is due.
        echo_s: Time within which a broker must return ``online`` [s].
    """

    def __init__(
        self,
        correct_messages: Callable[[], Sequence[Message]],
        delivery: DeliveryStats,
        denied: DeniedTopics,
        wake: Callable[[], object],
        echo_s: float = ECHO_S,
    ) -> None:
        self._correct_messages, self._delivery, self._denied = correct_messages, delivery, denied
        self._wake, self._echo_s = wake, echo_s
        self._echoed = asyncio.Event()
        self._is_wrong = False  # another client has overwritten an availability
        self._corrected_s = -math.inf

    def on_connected(self) -> None:
        """Reset for a new connection, on which both availabilities are published again."""
        self._echoed.clear()
        self._is_wrong = False

    def record_published(self) -> None:
        """Record that all messages, including the availabilities, were just published."""
        self._is_wrong = False

    def on_message(self, topic: str, payload: bytes) -> None:
        """Handle a received availability: our own echo, or another client's."""
        correct = {message.topic: message.payload for message in self._correct_messages()}
        # the sensor's availability has no correct value before the first snapshot, and then cannot be wrong
        if correct.get(topic, payload) == payload:
            self._echoed.set()
        elif not self._is_wrong:
            self._is_wrong = True
            loop = asyncio.get_running_loop()
            loop.call_at(max(self._corrected_s + CORRECTION_S, loop.time()), self._wake)

    async def correct(self, publish: Callable[[Sequence[Message]], Awaitable[None]]) -> None:
        """Publish the correct messages if an availability is wrong and ``CORRECTION_S`` has passed.

        The alarms are published, too, because a second service of the pack overwrites them before it ends.
        The correction is counted only after the broker's acknowledgment. A broker that shuts down publishes the will,
        which looks like another client's message, and acknowledges nothing.
        """
        now_s = asyncio.get_running_loop().time()
        since_s = now_s - self._corrected_s
        if not self._is_wrong or since_s < CORRECTION_S:
            return
        self._is_wrong, self._corrected_s = False, now_s
        await publish(self._correct_messages())
        self._delivery.corrections += 1
        if since_s > BURST_S:
            log.warning(
                "another client wrote an availability of this pack; corrected", so_far=self._delivery.corrections
            )

    async def expect_echo(self) -> None:
        """Detect a broker that denies the topic silently, as Mosquitto does with topics that may not be read."""
        topic = self._correct_messages()[0].topic
        try:
            async with asyncio.timeout(self._echo_s):
                await self._echoed.wait()
        except TimeoutError:
            if topic in self._delivery.refused_topics:
                return
            self._denied.deny(topic, "it is not returned: not allowed to read it, or the broker is slow")
            await self._echoed.wait()
            self._denied.allow(topic)


BIRTH_DELAY_S = 2.0
"""Delay from Home Assistant's birth message to the retained messages [s], because Home Assistant subscribes some time
after its birth message."""
QUEUE_DRAIN_TIMEOUT_S = 2.0
"""Time limit for sending queued messages at shutdown [s]."""
SHUTDOWN_TIMEOUT_S = 3.0
"""Timeout of the whole shutdown [s]."""

log = structlog.get_logger(__name__)


class MqttSink:
    """Publishes snapshots of one pack and answers requests.

    Args:
        settings: Brokers and credentials.
        device: Name of the pack in the topics.
        requests: Dispatcher of requests.
        delivery: Counters of sent messages.
        outbox: Queue of messages that must reach the broker.
        connect: Opens a connection; default: over TCP.
        sample_period_s: Sample period, if it may exceed the publish period [s].
        home_assistant: Settings of Home Assistant.
        alarms: Monitored alarms.
        venus_limits: Limits for Venus OS; None: nothing is published for it.
        first_delay_s: Delay after a lost connection or a temporary rejection [s].
        birth_delay_s: Delay from Home Assistant's birth message to the retained messages [s].
        echo_s: Time within which a broker must return ``online`` [s].

    Raises:
        UserError: A URL or a file of ``settings`` cannot be used.
    """

    def __init__(
        self,
        settings: MqttSettings,
        device: str,
        requests: RequestDispatcher,
        delivery: DeliveryStats,
        outbox: Outbox,
        *,
        connect: Connect | None = None,
        sample_period_s: float = 0.0,
        home_assistant: HomeAssistantSettings | None = None,
        alarms: Collection[str] = ALARMS,
        venus_limits: Mapping[str, float] | None = None,
        first_delay_s: float = FIRST_DELAY_S,
        birth_delay_s: float = BIRTH_DELAY_S,
        echo_s: float = ECHO_S,
    ) -> None:
        self._requests, self._delivery = requests, delivery
        self._denied = DeniedTopics(delivery, self._republish, first_delay_s)
        self._outbox, self._sender = outbox, QueueSender(outbox, delivery, self._denied, first_delay_s)
        self._birth_delay_s = birth_delay_s
        self._messages = MessageBuilder(
            settings.base_topic, device, sample_period_s, home_assistant, alarms, venus_limits
        )
        self._birth_topic = (home_assistant or HomeAssistantSettings()).status_topic
        identifier, will = f"bms-{device}-{secrets.token_hex(4)}", self._messages.offline_messages()[-1]
        options = ConnectOptions(identifier, will, lambda kind, topic: requests.count_refusal(kind, topic[:MAX_SHOWN]))
        for warning in check(settings):
            log.warning("secret is readable by other users", reason=warning)
        self._reconnect_loop = ReconnectLoop(
            brokers(settings), options, connect or BrokerConnector(settings), self._serve, delivery, first_delay_s
        )
        self._unsent: Snapshot | None = None
        self._last: Snapshot | None = None
        self._sent = PublishedState()  # set only by the sending task
        self._resend_retained = True
        self._wake = asyncio.Event()
        self._availability = AvailabilityMonitor(
            lambda: self._messages.corrections(self._sent), delivery, self._denied, self._wake.set, echo_s
        )
        self._task: asyncio.Task[None] | None = None

    def publish(self, snapshot: Snapshot) -> None:
        """Queue a snapshot for publication without waiting."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        for message in self._messages.guaranteed_messages(self._last, snapshot):
            self._queue(message)
        self._unsent = self._last = snapshot
        self._wake.set()

    def publish_raw(self, topic: str, payload: bytes, on_result: OnResult) -> None:
        """Publish a message of another component at QoS 1, queued during an outage like states, and report its result."""
        self._queue(Message(topic, payload, 1, retain=False), on_result)

    def _queue(self, message: Message, on_result: OnResult | None = None) -> None:
        """Queue a message until the broker acknowledges it. ``on_result`` receives its result."""
        self._outbox.put(message, on_result)
        self._sender.update_stats()

    async def __aenter__(self) -> Self:
        """Start connecting to the broker."""
        self._task = asyncio.create_task(self._reconnect_loop.run(), name="mqtt")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Publish queued messages and ``offline``, then disconnect.

        If this takes longer than ``SHUTDOWN_TIMEOUT_S``, the connection is dropped and the broker publishes the will.
        """
        if self._task is None:
            return
        self._reconnect_loop.closing.set()
        self._wake.set()
        await finish(self._task, SHUTDOWN_TIMEOUT_S)

    async def _serve(self, connection: Connection) -> None:
        """Send and receive until the connection is lost or the sink closes."""
        self._resend_retained = True  # the broker may have lost the retained messages
        self._denied.on_connected()
        self._availability.on_connected()
        try:
            async with asyncio.TaskGroup() as tasks:
                others = [tasks.create_task(self._receive(connection))]
                await self._subscribe(connection)
                others += [
                    tasks.create_task(self._availability.expect_echo()),
                    tasks.create_task(self._sender.send(connection)),
                ]
                await self._send(connection)
                for task in others:
                    task.cancel()
        finally:
            self._denied.on_disconnected()

    async def _subscribe(self, connection: Connection) -> None:
        """Subscribe, and report what the broker denies.

        Subscribe at QoS 0: Mosquitto counts a message that it withholds as too long among the messages in flight,
        where it stays at QoS 1.
        """
        availabilities = [self._topic(AVAILABILITY), self._topic(SENSOR_AVAILABILITY)]
        rejected = await connection.subscribe(self._topic("request/+"), [*availabilities, self._birth_topic])
        for topic, reason in rejected.items():
            self._denied.deny(topic, f"not allowed to read it: {reason}")

    async def _publish(self, connection: Connection, messages: Sequence[Message]) -> None:
        """Publish messages one after the other."""
        for message in messages:
            self._denied.record_result(message, await connection.publish(message))

    async def _send(self, connection: Connection) -> None:
        """Send live messages until the sink closes, then the offline messages."""
        self._wake.set()
        while True:
            await self._wake.wait()
            self._wake.clear()
            await asyncio.sleep(0)  # the outbox sends the state first
            if self._resend_retained:
                self._resend_retained, self._sent = False, PublishedState()
                self._availability.record_published()
                await self._publish(connection, self._messages.birth_messages())
            await self._availability.correct(lambda messages: self._publish(connection, messages))
            snapshot, self._unsent = self._unsent, None
            if snapshot is not None:
                now_s = asyncio.get_running_loop().time()
                self._messages.commands = self._requests.allowed
                messages, self._sent = self._messages.live_messages(self._sent, snapshot, now_s)
                await self._publish(connection, messages)
            if self._reconnect_loop.closing.is_set():
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(QUEUE_DRAIN_TIMEOUT_S):
                        await self._sender.wait_until_empty()
                await self._publish(connection, self._messages.offline_messages())
                return

    async def _receive(self, connection: Connection) -> None:
        """Answer requests, handle Home Assistant's birth message, and check the availability topics."""
        while True:
            message = await connection.receive()
            if message.topic == self._birth_topic:
                if message.payload == b"online" and not message.retain:
                    asyncio.get_running_loop().call_later(self._birth_delay_s, self._republish)
            elif message.topic in (self._topic(AVAILABILITY), self._topic(SENSOR_AVAILABILITY)):
                if not message.retain:  # a retained message may have been corrected since
                    self._availability.on_message(message.topic, message.payload)
            else:
                await self._answer(connection, message)

    async def _answer(self, connection: Connection, message: ReceivedMessage) -> None:
        name = message.topic.rsplit("/", 1)[-1]
        if message.retain:  # a retained request would be executed again with each connection
            self._requests.count_refusal("retained", name[:MAX_SHOWN])
            return
        response = await self._requests.handle(name, message.payload)
        if response is not None:  # the name is a known request
            # not at QoS 1: in a flood the broker acknowledges late, and waiting for that would stop reading
            await connection.publish(Message(self._topic(f"response/{name}"), response, 0, retain=False))

    def _republish(self) -> None:
        """Send all retained messages again with the next snapshot."""
        self._resend_retained = True

    def _topic(self, name: str) -> str:
        return f"{self._messages.root}/{name}"
