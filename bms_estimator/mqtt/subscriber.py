"""Subscriber to all devices of a broker. It stores their latest messages and reconnects."""

import asyncio
import secrets
from collections.abc import Callable, Mapping
from typing import Self

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
from bms_estimator.mqtt.topic_cache import DeviceMessage, DeviceTopics, TopicCache
from bms_estimator.process.runtime import FIRST_DELAY_S, finish
from bms_estimator.settings.outputs import MqttSettings

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
