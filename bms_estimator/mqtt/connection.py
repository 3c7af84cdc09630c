"""Interface of a connection to a broker, implemented by ``client``."""

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from typing import NamedTuple, Protocol

from bms_estimator.mqtt.broker_config import Broker
from bms_estimator.mqtt.message import Message
from bms_estimator.mqtt.receive_queue import MAX_BYTES, MAX_WAITING


class BrokerConnectionError(Exception):
    """The broker cannot be reached, refuses the connection, or the connection is lost.

    The message gives the reason.
    """


class ReceivedMessage(NamedTuple):
    """A received message."""

    topic: str
    payload: bytes
    retain: bool


class PublishRejection(NamedTuple):
    """The broker's no to a message."""

    why: str
    is_retryable: bool
    """True if the message may be accepted later."""


class ConnectOptions(NamedTuple):
    """Options of each connection of a client."""

    identifier: str
    """Client identifier, equal for all connections, so that the broker ends an older one first and publishes its will
    before."""
    will: Message | None
    """Last will; None for a reader."""
    on_message_lost: Callable[[str, str], None]
    """Callback with kind (``too_long``, ``overflow``) and topic of each discarded message."""
    most_waiting: int = MAX_WAITING
    """Messages that wait to be read; more are lost."""
    most_bytes: int = MAX_BYTES
    """Maximum size of a received message [bytes]. An MQTT 5 broker withholds longer ones; else they are dropped here."""


class Connection(Protocol):
    """A connection while it lasts; every method raises BrokerConnectionError when it is lost."""

    protocol: str
    """Name of the MQTT version."""

    async def subscribe(self, requests: str | None, others: Sequence[str]) -> dict[str, str]:
        """Ask for messages at QoS 0.

        Args:
            requests: Topic filter subscribed with retain-as-published (MQTT 5), so that retained messages can be
                recognized; None: nowhere.
            others: Further topics.

        Returns:
            The topics that the broker refuses, and why.
        """

    async def publish(self, message: Message) -> PublishRejection | None:
        """Hand over a message and wait until the broker has acknowledged it.

        Messages of several tasks are sent in the order of their calls.

        Returns:
            The broker's rejection, if it reports one.
        """

    async def receive(self) -> ReceivedMessage:
        """Wait for the next message."""


Connect = Callable[[Broker, ConnectOptions], AbstractAsyncContextManager[Connection]]
"""Connects to a broker; entering raises BrokerConnectionError, and within a bounded time."""
