"""The order of what waits for the broker, in memory and on disk. Pure: no disk, no clock, no task.

From the oldest to the newest a message is on its way (``handed``), ready to be handed out, on disk alone
(``Stored``), or in the tail of what came last. While the broker takes what comes, nothing goes beyond ready.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

from bms_estimator.sinks.messages import Message

MEMORY_MOST = 4096
"""Messages of the tail: some megabytes, and an hour of states for a disk that cannot be written."""
PAGE = 1000
"""Messages that are ready; the next ones are read from disk once half of them are gone."""


class Waiting(NamedTuple):
    """A message on its way to the broker."""

    number: int
    """Rises by one with each message."""
    message: Message


@dataclass
class Stored:
    """What is on disk alone: numbers from ``first`` to before ``end``."""

    first: int = 0
    end: int = 0
    count: int = 0
    drops: int = 0
    """The oldest of them, to be removed."""


@dataclass
class Queue:
    """Messages in order.

    Attributes:
        most: So many are kept; of more the oldest that is not on its way is dropped.
        dropped: Messages that found no room.
        next: The number of the next message.
        handed: On their way, not yet acknowledged.
        gone: Numbers that may be on disk and need not be any more.
        sure: Whether it is known what is on disk; if not, what is in memory is written again.
        passing: Hand out what came last though older ones are on disk, which cannot be read.
    """

    most: int
    dropped: int = 0
    next: int = 0
    handed: dict[int, Waiting] = field(default_factory=dict)
    gone: list[int] = field(default_factory=list)
    sure: bool = True
    passing: bool = False
    stored: Stored = field(default_factory=Stored)
    _ready: deque[Waiting] = field(default_factory=deque)
    _tail: deque[Waiting] = field(default_factory=deque)
    _written: set[int] = field(default_factory=set)  # in memory, and on disk as well

    @property
    def waiting(self) -> int:
        """Messages that are not acknowledged."""
        return len(self.handed) + len(self._ready) + self.stored.count + len(self._tail)

    @property
    def oldest(self) -> int | None:
        """The lowest number that waits."""
        if self.stored.count and not self.handed and not self._ready:
            return self.stored.first
        return next((waiting.number for waiting in self._in_memory()), None)

    @property
    def can_hand_out(self) -> bool:
        """Whether ``hand_out`` gives something."""
        return bool(self._ready or (self._tail and (self.passing or not self.stored.count)))

    @property
    def hungry(self) -> bool:
        """Whether it is time to read from disk."""
        return self.stored.count > 0 and len(self._ready) < PAGE // 2

    def put(self, message: Message) -> None:
        """Take the newest message."""
        self._tail.append(Waiting(self.next, message))
        self.next += 1
        if self.waiting > self.most:
            self._drop_oldest()
        if len(self._tail) > MEMORY_MOST:
            self._forget(self._tail.popleft().number)
            self.dropped += 1

    def hand_out(self, most: int) -> list[Waiting]:
        """Up to ``most`` of the oldest."""
        taken: list[Waiting] = []
        while len(taken) < most and self.can_hand_out:
            taken.append((self._ready or self._tail).popleft())
        self.handed |= {waiting.number: waiting for waiting in taken}
        return taken

    def sent(self, number: int) -> None:
        """A message is acknowledged."""
        if self.handed.pop(number, None):
            self._forget(number)

    def rewind(self) -> None:
        """Nothing is on its way any more."""
        self._ready.extendleft(reversed(self.handed.values()))
        self.handed.clear()

    def unwritten(self) -> list[Waiting]:
        """What is in memory alone."""
        return [waiting for waiting in self._in_memory() if not self.sure or waiting.number not in self._written]

    def writing(self, rows: Iterable[Waiting]) -> None:
        """From now on these may be on disk."""
        self._written.update(waiting.number for waiting in rows)

    def wrote(self) -> None:
        """What was to be written is on disk: of the tail, memory keeps what is ready."""
        while self._tail and self._tail[0].number in self._written:
            newest = self._tail.popleft()
            if not self.stored.count and len(self._ready) < PAGE:
                self._ready.append(newest)
            else:
                self._written.discard(newest.number)
                first = self.stored.first if self.stored.count else newest.number
                self.stored = Stored(first, newest.number + 1, self.stored.count + 1, self.stored.drops)

    def loaded(self, rows: list[Waiting], asked: int) -> None:
        """The oldest of what is on disk alone were read."""
        stored = self.stored
        if rows:
            stored.first = rows[-1].number + 1
        self._written.update(waiting.number for waiting in rows)
        dropped = max(len(rows) - stored.count, 0)  # meanwhile; what was to be removed of them is here now
        for waiting in rows[:dropped]:
            self._forget(waiting.number)
        stored.drops -= dropped
        known = {waiting.number for waiting in self._in_memory()}
        self._ready.extend(waiting for waiting in rows[dropped:] if waiting.number not in known)
        stored.count -= len(rows) - dropped
        if len(rows) < asked:  # what else was there is lost
            self.dropped += stored.count
            stored.count = 0

    def found(self, count: int, span: int) -> int:
        """An earlier run left messages on disk: they go before all that was not handed out.

        Args:
            count: How many.
            span: From the number of the first to that of the last, and one.

        Returns:
            The number that the first of them gets.
        """
        first = self._tail[0].number if self._tail else self.next
        self._tail = deque(Waiting(waiting.number + span, waiting.message) for waiting in self._tail)
        self.next += span
        self.stored = Stored(first, first + span, count)
        for _ in range(self.waiting - self.most):
            self._drop_oldest()
        return first

    def left(self, count: int) -> None:
        """So many of what was on disk alone are still there."""
        lost = self.stored.count + self.stored.drops - count
        if lost > 0:
            self.dropped += lost
            self.stored.count = max(self.stored.count - lost, 0)

    def _in_memory(self) -> Iterator[Waiting]:
        return chain(self.handed.values(), self._ready, self._tail)

    def _forget(self, number: int) -> None:
        """What may be on disk need not be any more."""
        if number in self._written:
            self._written.discard(number)
            self.gone.append(number)

    def _drop_oldest(self) -> None:
        if self._ready:
            self._forget(self._ready.popleft().number)
        elif self.stored.count:
            self.stored.count -= 1
            self.stored.drops += 1
        elif self._tail:
            self._forget(self._tail.popleft().number)
        else:
            return
        self.dropped += 1
