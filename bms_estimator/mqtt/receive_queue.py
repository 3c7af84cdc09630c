"""Queue of received messages."""

import asyncio
from collections.abc import Callable

import aiomqtt


class ReceiveQueue(asyncio.Queue[aiomqtt.Message]):
    """Queue of received messages with limits of their number and size. Lost messages are reported.

    Args:
        on_lost: Callback with reason and topic of each lost message.
        max_bytes: Maximum size of a message with its topic [bytes].
        maxsize: Maximum number of messages.
    """

    def __init__(self, on_lost: Callable[[str, str], None], max_bytes: int, maxsize: int) -> None:
        super().__init__(maxsize)
        self._on_lost, self._max_bytes = on_lost, max_bytes

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Append a message, or report its loss."""
        topic = item.topic.value
        if len(topic) + len(item.payload) > self._max_bytes:
            self._on_lost("too_long", topic)
        elif self.full():
            self._on_lost("overflow", topic)
        else:
            super().put_nowait(item)
