"""An MQTT broker inside the process, for the demo: nothing to install, loopback only.

Not for a real pack: it has no passwords and no persistence, see ``_Broker``.
"""

import asyncio
import contextlib
import errno
import logging
import socket
from typing import Self

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
from amqtt.broker import Broker
from amqtt.contexts import BrokerConfig, ListenerConfig
from amqtt.session import Session

from bms_estimator.model.errors import UserError

MQTT_PORT = 1883
"""Default port of MQTT clients."""
LOOPBACK = "127.0.0.1"
DELIVERY_S, LOOK_S = 5.0, 0.02
"""Time that the broker gives its clients at its end for pending messages, and its poll interval [s]."""
ANONYMOUS = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
MQTT_5 = b"MQTT\x05"
"""Bytes of an MQTT 5 client's CONNECT after its length."""
UNSUPPORTED_VERSION = b"\x20\x02\x00\x01"
"""CONNACK for an unsupported protocol version."""


class _Broker(Broker):  # type: ignore[misc]  # amqtt carries no types
    """amqtt 0.12, put right where it is wrong.

    It hands a client that connects the retained messages of everyone's subscriptions: only its own are right. It
    misreads the MQTT 5 fields of a CONNECT and waits for more; the client must learn that it speaks 3.1.1.
    """

    async def stream_connected(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, listener_name: str
    ) -> None:
        try:
            start = await reader.readuntil(MQTT_5[:-1]) + await reader.readexactly(1)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ConnectionError):
            writer.close()
            return
        if not start.endswith(MQTT_5):
            await self.external_connected(_Again(start, reader), StreamWriterAdapter(writer), listener_name)
            return
        writer.write(UNSUPPORTED_VERSION)
        with contextlib.suppress(ConnectionError):
            await writer.drain()
        writer.close()

    @property
    def idle(self) -> bool:
        """True if all received messages were delivered or dropped."""
        handed_on = all(
            session is None or session.delivered_message_queue.empty() for session, _ in self._sessions.values()
        )
        return handed_on and self._broadcast_queue.empty() and all(task.done() for task in self._tasks_queue)

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        topic_filter, _ = subscription
        if any(subscriber is session for subscriber, _ in self._subscriptions.get(topic_filter, ())):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class _Again(StreamReaderAdapter):  # type: ignore[misc]  # as above
    """A reader whose first bytes were already read."""

    def __init__(self, start: bytes, reader: asyncio.StreamReader) -> None:
        super().__init__(reader)
        self._start = start

    async def read(self, n: int = -1) -> bytes:
        start, self._start = self._start[:n], self._start[n:]
        rest: bytes = await super().read(n - len(start))
        return start + rest


class DemoBroker:
    """A broker on loopback while the context lasts.

    Args:
        port: TCP port; None: 1883 when it is free, else any that is.

    Raises:
        UserError: The requested port is in use.
    """

    def __init__(self, port: int | None = None) -> None:
        self.port = choose_port(port, MQTT_PORT)
        logging.getLogger("amqtt").setLevel(
            logging.CRITICAL
        )  # it logs a stack trace when a client disconnects without a packet
        listener = ListenerConfig(bind=f"{LOOPBACK}:{self.port}")
        self._broker = _Broker(BrokerConfig(listeners={"default": listener}, plugins=ANONYMOUS))

    @property
    def url(self) -> str:
        """Address for ``mqtt.url``."""
        return f"mqtt://{LOOPBACK}:{self.port}"

    @property
    def look_command(self) -> str:
        """Command that shows all topics in a second terminal."""
        port = "" if self.port == MQTT_PORT else f" -p {self.port}"
        return f"mosquitto_sub{port} -t 'bms/#' -v"

    async def __aenter__(self) -> Self:
        """Start listening."""
        await self._broker.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Disconnect all clients after their queued messages, which would otherwise be dropped."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(DELIVERY_S):
                await self._stand_idle()
        await self._broker.shutdown()

    async def _stand_idle(self) -> None:
        """Wait until nothing has moved between two checks: a message in transit is in no queue."""
        looks = 0
        while looks < 2:
            await asyncio.sleep(LOOK_S)
            looks = looks + 1 if self._broker.idle else 0


def choose_port(port: int | None, usual: int) -> int:
    """Return the port to listen on: the requested one, otherwise the usual one, otherwise a free one.

    Raises:
        UserError: The requested port is in use.
    """
    if port is not None:
        if not _free(port):
            raise UserError(f"port {port}: taken by another program; leave --port out to have a free one chosen")
        return port
    return usual if _free(usual) else _any_free()


def _free(port: int) -> bool:
    """Return True if the port is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):
                return False
            raise
    return True


def _any_free() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
