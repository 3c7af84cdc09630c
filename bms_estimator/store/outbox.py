"""Messages that must reach the broker: they wait here, oldest first, until it has acknowledged them."""

import asyncio
from collections import deque
from typing import NamedTuple, Self

from bms_estimator.sinks.messages import Message

MEMORY_MOST = 4096
"""Messages that are kept in memory: some megabytes."""


class Waiting(NamedTuple):
    """A message on its way to the broker."""

    number: int
    """Rises by one with each message."""
    message: Message


class Outbox:
    """Keeps messages in order until the broker has them.

    Args:
        database: None: in memory only.
        most: So many are kept; of more the oldest that is not on its way is dropped.

    Attributes:
        connected: Whether there is a broker; whoever sends says so.
        dropped: Messages that found no room, since start.
    """

    def __init__(self, database: None, *, most: int) -> None:  # noqa: ARG002 - the database comes next
        self._most = most
        self._next = 0
        self._handed: dict[int, Waiting] = {}  # on their way: not yet acknowledged
        self._ready: deque[Waiting] = deque()
        self._filled = asyncio.Event()
        self.connected = False
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """Messages that the broker has not acknowledged."""
        return len(self._handed) + len(self._ready)

    async def __aenter__(self) -> Self:
        """Start."""
        return self

    async def __aexit__(self, *_error: object) -> None:
        """End."""

    def put(self, message: Message) -> None:
        """Keep a message; returns at once and never fails."""
        self._ready.append(Waiting(self._next, message))
        self._next += 1
        if self.waiting > self._most:
            self._ready.popleft()
            self.dropped += 1
        if self._ready:
            self._filled.set()

    async def take(self, most: int) -> list[Waiting]:
        """Wait until there is a message, and hand out up to ``most`` of the oldest that were not since ``rewind``."""
        while not self._ready:
            self._filled.clear()
            await self._filled.wait()
        taken = [self._ready.popleft() for _ in range(min(most, len(self._ready)))]
        self._handed |= {waiting.number: waiting for waiting in taken}
        return taken

    def sent(self, number: int) -> None:
        """The broker has acknowledged a message."""
        self._handed.pop(number, None)

    def rewind(self) -> None:
        """A connection is lost: hand out again, in order, what was not acknowledged."""
        self._ready.extendleft(reversed(self._handed.values()))
        self._handed.clear()
        if self._ready:
            self._filled.set()
