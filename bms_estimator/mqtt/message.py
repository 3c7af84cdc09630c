"""Messages for a broker."""

from collections.abc import Callable
from typing import NamedTuple

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
