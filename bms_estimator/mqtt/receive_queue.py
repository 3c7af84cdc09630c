"""Queue of received messages."""

import asyncio
from collections.abc import Callable

import aiomqtt

MAX_WAITING = 100
"""Messages that wait to be read; more are lost."""
MAX_BYTES = 16_384
"""Maximum length of a received message [bytes]: an MQTT 5 broker enforces it, longer ones of an older broker are
discarded."""


class ReceiveQueue(asyncio.Queue[aiomqtt.Message]):
    """Queue of received messages, bounded in number and bytes; lost messages are logged at intervals.

    Args:
        lose: Called with reason and topic of each lost message.
        most_bytes: Maximum size of a message with its topic.
        maxsize: Messages.
    """

    def __init__(self, lose: Callable[[str, str], None], most_bytes: int, maxsize: int) -> None:
        super().__init__(maxsize)
        self._lose, self._most_bytes = lose, most_bytes

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Take a message, or report its loss."""
        topic = item.topic.value
        if len(topic) + len(item.payload) > self._most_bytes:
            self._lose("too_long", topic)
        elif self.full():
            self._lose("overflow", topic)
        else:
            super().put_nowait(item)
