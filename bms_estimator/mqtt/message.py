"""Messages for a broker."""

from typing import NamedTuple


class Message(NamedTuple):
    """One message."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class QueuedMessage(NamedTuple):
    """A message on its way to the broker."""

    number: int
    """Position in the queue, one higher for each message."""
    message: Message
