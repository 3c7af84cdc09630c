"""Messages for a broker."""

from typing import NamedTuple


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
