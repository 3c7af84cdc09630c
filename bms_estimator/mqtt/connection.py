"""Messages, and interface of a connection to a broker, implemented by ``client``."""

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from typing import NamedTuple, Protocol

from bms_estimator.mqtt.broker_config import Broker
from bms_estimator.mqtt.receive_queue import MAX_BYTES, MAX_WAITING

OnResult = Callable[[str], object]
"""Callback for the result of a message: the reason why the message was rejected or lost, or "" if it was acknowledged."""


class Message(NamedTuple):
    """MQTT message."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class QueuedMessage(NamedTuple):
    """Message on its way to the broker."""

    number: int
    """Position in the queue; consecutive messages have consecutive numbers."""
    message: Message


class BrokerConnectionError(Exception):
    """The broker cannot be reached, refuses the connection, or the connection is lost.

    The message gives the reason.
    """


class LoginError(BrokerConnectionError):
    """The broker rejects the user name and the password, or requires them."""


class ReceivedMessage(NamedTuple):
    """Received message."""

    topic: str
    payload: bytes
    retain: bool


class PublishRejection(NamedTuple):
    """Rejection of a message by the broker."""

    reason: str
    is_retryable: bool
    """True if the message may be accepted later."""


class ConnectOptions(NamedTuple):
    """Options of each connection of a client."""

    identifier: str
    """Client identifier, equal for all connections. The broker therefore closes an older connection and publishes its
    will before it accepts a new one."""
    will: Message | None
    """Last will; None for a client that only reads."""
    on_message_lost: Callable[[str, str], None]
    """Callback with kind (``too_long``, ``overflow``) and topic of each discarded message."""
    max_waiting: int = MAX_WAITING
    """Maximum number of received messages that wait to be read; further messages are lost."""
    max_bytes: int = MAX_BYTES
    """Maximum size of a received message [bytes]. An MQTT 5 broker withholds longer messages. Longer messages of an
    older broker are discarded on arrival."""


class Connection(Protocol):
    """Open connection to a broker. Every method raises BrokerConnectionError if it is lost."""

    protocol: str
    """Name of the MQTT version."""

    async def subscribe(self, requests: str | None, others: Sequence[str]) -> dict[str, str]:
        """Subscribe at QoS 0.

        Args:
            requests: Topic filter subscribed with retain-as-published (MQTT 5), so that retained messages can be
                recognized; None: no request topics.
            others: Further topics.

        Returns:
            Rejected topics with the broker's reasons.
        """

    async def publish(self, message: Message) -> PublishRejection | None:
        """Send a message and wait until the broker has acknowledged it.

        Messages of several tasks are sent in the order of their calls.

        Returns:
            The broker's rejection, if it reports one.
        """

    async def receive(self) -> ReceivedMessage:
        """Wait for the next message."""


Connect = Callable[[Broker, ConnectOptions], AbstractAsyncContextManager[Connection]]
"""Function that connects to a broker. Entering its context succeeds or raises BrokerConnectionError within a bounded
time."""
