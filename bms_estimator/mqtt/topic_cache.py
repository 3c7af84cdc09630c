"""Last messages of devices by topic, parsed, and the subscriber that receives them.

Any client may publish anything, so the memory is bounded and payloads of any kind are accepted.
"""

import asyncio
import json
import math
import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import structlog

from bms_estimator.model.clock import Clock
from bms_estimator.mqtt.connection import (
    BrokerConnectionError,
    Connect,
    Connection,
    ConnectOptions,
    DeliveryStats,
    brokers,
    check,
)
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.process.runtime import FIRST_DELAY_S, finish
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.pack import DEVICE_NAME

MAX_DEVICES = 64
"""Maximum number of stored devices."""
MAX_TOPICS = 64
"""Maximum number of topics of one device; messages on further topics are ignored."""
MAX_DEVICE_BYTES = 128 * 1024
"""Maximum total size of the payloads of one device [bytes]. A message that would exceed this size is ignored."""
MAX_HIDDEN = 10_000
"""Maximum number of counted devices that are not stored."""
SILENT_S = 30.0
"""Minimum silence after which a device may be replaced by a new device [s]. A new device with a raised alarm replaces a
device without an alarm at once."""
REQUEST_LEVELS = ("request", "response")
"""First level of topics without device state."""
ALARM = "alarm/"
"""Prefix of alarm topics."""


class DeviceMessage(NamedTuple):
    """Message of a device."""

    device: str
    topic: str
    """Topic below the device's, such as ``state`` or ``alarm/soc_low``."""
    payload: Any
    """Parsed JSON; text if it is not JSON; None if the topic was cleared."""


@dataclass
class DeviceTopics:
    """Last messages of one device."""

    topics: dict[str, Any] = field(default_factory=dict)
    """Payloads by topic, parsed JSON or text."""
    received_s: dict[str, float] = field(default_factory=dict)
    """Time of the last message by topic, seconds since 1970."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Sizes of the payloads [bytes]."""
    alarms: set[str] = field(default_factory=set)
    """Topics of the alarms that are raised."""
    last_s: float = 0.0
    """Time of the last message, seconds since 1970."""

    @property
    def priority(self) -> tuple[bool, float]:
        """Rank by which devices are stored: raised alarms first, then the last message."""
        return bool(self.alarms), self.last_s


class TopicCache:
    """Last messages of each device below a base topic.

    Args:
        base_topic: First part of all topics.
        on_hidden: Called with the name of a device that is not stored: a new device, or a device that was replaced.
    """

    def __init__(self, base_topic: str, on_hidden: Callable[[str], object] = str) -> None:
        self._root, self._on_hidden = f"{base_topic}/", on_hidden
        self.devices: dict[str, DeviceTopics] = {}
        """Devices by name, in the order of their first message."""
        self._hidden: set[str] = set()

    @property
    def hidden(self) -> int:
        """Number of devices that publish but are not stored, at most ``MAX_HIDDEN``."""
        return len(self._hidden)

    def add_message(self, topic: str, payload: bytes, now_s: float) -> DeviceMessage | None:
        """Store a message.

        Args:
            topic: Full topic.
            payload: Received payload; empty if the topic was cleared.
            now_s: Arrival time, seconds since 1970.

        Returns:
            The parsed message; None if the topic is not a device's, or a limit is exceeded.
        """
        name, _, device_topic = topic.removeprefix(self._root).partition("/")
        if not topic.startswith(self._root) or not device_topic or device_topic.split("/")[0] in REQUEST_LEVELS:
            return None
        if not re.fullmatch(DEVICE_NAME, name):
            return None
        if not payload:
            return self._remove_topic(name, device_topic)
        return self._store(name, device_topic, payload, now_s)

    def _store(self, name: str, topic: str, payload: bytes, now_s: float) -> DeviceMessage | None:
        value = parse_payload(payload)
        is_raised_alarm = topic.startswith(ALARM) and isinstance(value, dict) and value.get("active") is True
        device = self.devices.get(name) or DeviceTopics()
        if topic not in device.topics and len(device.topics) >= MAX_TOPICS:
            return None
        if sum(device.sizes.values()) + len(payload) - device.sizes.get(topic, 0) > MAX_DEVICE_BYTES:
            return None
        if name not in self.devices and not self._make_room(now_s, urgent=is_raised_alarm):
            self._hide(name)
            return None
        device.topics[topic], device.received_s[topic], device.sizes[topic] = value, now_s, len(payload)
        device.last_s = now_s
        (device.alarms.add if is_raised_alarm else device.alarms.discard)(topic)
        self.devices[name] = device
        self._hidden.discard(name)
        return DeviceMessage(name, topic, value)

    def _make_room(self, now_s: float, *, urgent: bool) -> bool:
        """Return True if one more device may be stored; drop the device with the lowest priority if necessary.

        Args:
            now_s: Present time, seconds since 1970.
            urgent: True if the new device has a raised alarm.
        """
        if len(self.devices) < MAX_DEVICES:
            return True
        name = min(self.devices, key=lambda each: self.devices[each].priority)
        is_silent = now_s - self.devices[name].last_s >= SILENT_S
        if not is_silent and not (urgent and not self.devices[name].alarms):
            return False
        del self.devices[name]
        self._hide(name)
        return True

    def _hide(self, name: str) -> None:
        if len(self._hidden) < MAX_HIDDEN:
            self._hidden.add(name)
        self._on_hidden(name)

    def _remove_topic(self, name: str, topic: str) -> DeviceMessage | None:
        self._hidden.discard(name)
        device = self.devices.get(name)
        if device is None or topic not in device.topics:
            return None
        del device.topics[topic], device.received_s[topic], device.sizes[topic]
        device.alarms.discard(topic)
        if not device.topics:
            del self.devices[name]
        return DeviceMessage(name, topic, None)


def parse_payload(payload: bytes) -> Any:
    """Parse JSON in which all numbers are finite; return anything else as text."""
    try:
        return json.loads(payload, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError):
        return payload.decode(errors="replace")


def _finite(token: str) -> float:
    """Parse a finite number of a payload.

    Raises:
        ValueError: It is NaN or infinite, which is invalid JSON.
    """
    number = float(token)
    if not math.isfinite(number):
        raise ValueError(token)
    return number


MAX_WAITING = 2000
"""Maximum number of messages that wait to be read. On subscription a broker sends all retained messages at once, about
twenty for each device."""
MAX_BYTES = 65_536
"""Maximum length of a message [bytes]. The longest message, of topic ``schema``, has a quarter of this length."""
LOSS_REASONS = {"too_long": f"longer than {MAX_BYTES} bytes", "overflow": "faster than they are read"}
"""Reasons for dropped messages, by their name in ``ConnectOptions.on_message_lost``."""
LOG_S = 60.0
"""Minimum time between two log lines on dropped messages [s]."""
SHUTDOWN_TIMEOUT_S = 3.0
"""Timeout of a disconnect from the broker [s]."""


log = structlog.get_logger(__name__)


class Subscriber:
    """Receives ``<base_topic>/#`` within the context.

    Args:
        settings: Brokers and credentials.
        on_message: Called with each message of a device after it is stored.
        on_link_change: Called after the broker was connected or lost; ``lost_since`` distinguishes the two.
        connect: Opens a connection; default: over TCP.
        on_hidden: Called with the name of a device that is not stored because there are too many; ``str`` does nothing.
        clock: Wall clock and monotonic clock.
        first_delay_s: Delay before a lost broker is retried [s]; it grows as in ``Backoff``.

    Raises:
        UserError: A URL or a file of ``settings`` cannot be used.
    """

    def __init__(
        self,
        settings: MqttSettings,
        on_message: Callable[[DeviceMessage], None] = lambda _: None,
        on_link_change: Callable[[], None] = lambda: None,
        *,
        connect: Connect | None = None,
        on_hidden: Callable[[str], object] = str,
        clock: Clock | None = None,
        first_delay_s: float = FIRST_DELAY_S,
    ) -> None:
        check(settings)
        self._on_message, self._on_link_change, self._clock = on_message, on_link_change, clock or Clock()
        self._topic = f"{settings.base_topic}/#"
        self._cache = TopicCache(settings.base_topic, on_hidden)
        self._delivery = DeliveryStats()
        self._lost_since: float | None = self._clock.wall()
        options = ConnectOptions(
            f"bms-view-{secrets.token_hex(4)}",
            will=None,
            on_message_lost=self._count_lost,
            max_waiting=MAX_WAITING,
            max_bytes=MAX_BYTES,
        )
        connect = connect or BrokerConnector(settings)
        self._reconnect_loop = ReconnectLoop(
            brokers(settings), options, connect, self._serve, self._delivery, first_delay_s
        )
        self._task: asyncio.Task[None] | None = None
        self._loss_log_time_s: float | None = None
        self.lost_messages = 0
        """Number of messages that were too long or arrived too fast."""

    @property
    def devices(self) -> Mapping[str, DeviceTopics]:
        """Last messages of each device by name, in the order of the devices' first messages."""
        return self._cache.devices

    @property
    def hidden(self) -> int:
        """Number of devices that publish but are not stored, because there are too many."""
        return self._cache.hidden

    @property
    def lost_since(self) -> float | None:
        """Time at which the broker was lost [s since 1970]; None while connected.

        Raises:
            Exception: An exception of a callback, which has ended the task.
        """
        if self._task is not None and self._task.done() and not self._task.cancelled():
            self._task.result()
        return self._lost_since

    @property
    def trouble(self) -> str | None:
        """Reason for the lost or failed connection; None while connected."""
        return self._delivery.trouble

    async def __aenter__(self) -> Self:
        """Start connecting to the broker."""
        self._task = asyncio.create_task(self._reconnect_loop.run(), name="subscriber")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Disconnect from the broker.

        Raises:
            Exception: An exception of a callback, which has ended the task.
        """
        if self._task is None:
            return
        self._reconnect_loop.closing.set()
        await finish(self._task, SHUTDOWN_TIMEOUT_S)

    async def _serve(self, connection: Connection) -> None:
        """Receive until the connection is lost or the subscriber closes."""
        for topic, reason in (await connection.subscribe(self._topic, [])).items():
            raise BrokerConnectionError(f"not allowed to read {topic}: {reason}")
        self._report_link(None)
        try:
            async with asyncio.TaskGroup() as tasks:
                receiving = tasks.create_task(self._receive(connection))
                await self._reconnect_loop.closing.wait()
                receiving.cancel()
        finally:
            self._report_link(self._clock.wall())

    async def _receive(self, connection: Connection) -> None:
        while True:
            message = await connection.receive()
            device_message = self._cache.add_message(message.topic, message.payload, self._clock.wall())
            if device_message is not None:
                self._on_message(device_message)

    def _report_link(self, lost_since: float | None) -> None:
        self._lost_since = lost_since
        self._on_link_change()

    def _count_lost(self, kind: str, topic: str) -> None:
        self.lost_messages += 1
        now_s = self._clock.monotonic()
        if self._loss_log_time_s is None or now_s >= self._loss_log_time_s + LOG_S:
            self._loss_log_time_s = now_s
            log.warning("messages are dropped", reason=LOSS_REASONS[kind], topic=topic, dropped=self.lost_messages)
