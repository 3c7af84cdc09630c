"""The order of what waits for the broker, in memory and on disk. Pure: no disk, no clock, no task.

From the oldest to the newest, a message is sent (``in_flight``), ready to be sent, on disk only (``stored``), or in
the tail of the newest. While the broker accepts messages, none goes beyond ready.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from bms_estimator.mqtt.message import Message, QueuedMessage
from bms_estimator.store.number_ranges import NumberRanges

MEMORY_MOST = 4096
"""Messages of the tail: some megabytes, and an hour of states for a disk that cannot be written."""
PAGE = 1000
"""Messages that are ready; the next ones are read from disk once half of them are gone."""


LOWEST = -(1 << 62)
"""Number below all others, here and on disk."""


@dataclass
class Queue:
    """Messages in order.

    Attributes:
        most: Maximum number of stored messages; beyond it the oldest one not in flight is dropped.
        dropped: Messages that found no room.
        next: The number of the next message.
        in_flight: Sent and not yet acknowledged.
        stale: True if the disk may contain messages that are not queued any more.
        disk_state_known: True if the content of the disk is known; if not, the messages in memory are written again.
        stored: Messages on disk only.
        skip_disk: Return the newest messages although older ones are on disk, which cannot be read.
    """

    most: int
    dropped: int = 0
    next: int = 0
    in_flight: dict[int, QueuedMessage] = field(default_factory=dict)
    stale: bool = False
    disk_state_known: bool = True
    skip_disk: bool = False
    stored: NumberRanges = field(default_factory=NumberRanges)
    _ready: deque[QueuedMessage] = field(default_factory=deque)
    _tail: deque[QueuedMessage] = field(default_factory=deque)
    _written: set[int] = field(default_factory=set)  # in memory, and on disk as well

    @property
    def waiting(self) -> int:
        """Messages that are not acknowledged."""
        return len(self.in_flight) + len(self._ready) + len(self.stored) + len(self._tail)

    @property
    def oldest(self) -> int | None:
        """The lowest number that waits."""
        if self.stored and not self.in_flight and not self._ready:
            return self.stored.first
        return next((waiting.number for waiting in self._in_memory()), None)

    @property
    def can_hand_out(self) -> bool:
        """True if ``take_next`` returns a message."""
        return bool(self._ready or (self._tail and (self.skip_disk or not self.stored)))

    @property
    def needs_page(self) -> bool:
        """True if messages should be read from disk."""
        return bool(self.stored) and len(self._ready) < PAGE // 2

    def put(self, message: Message) -> None:
        """Take the newest message."""
        self._tail.append(QueuedMessage(self.next, message))
        self.next += 1
        if self.waiting > self.most:
            self._drop_oldest()
        if len(self._tail) > MEMORY_MOST:
            self._forget(self._tail.popleft().number)
            self.dropped += 1

    def take_next(self, most: int) -> list[QueuedMessage]:
        """Up to ``most`` of the oldest."""
        taken: list[QueuedMessage] = []
        while len(taken) < most and self.can_hand_out:
            taken.append((self._ready or self._tail).popleft())
        self.in_flight |= {waiting.number: waiting for waiting in taken}
        return taken

    def sent(self, number: int) -> None:
        """Record that a message is acknowledged."""
        if self.in_flight.pop(number, None):
            self._forget(number)

    def rewind(self) -> None:
        """Nothing is on its way any more."""
        self._ready.extendleft(reversed(self.in_flight.values()))
        self.in_flight.clear()

    def unwritten(self) -> list[QueuedMessage]:
        """Return the messages that are in memory only."""
        return [
            waiting for waiting in self._in_memory() if not self.disk_state_known or waiting.number not in self._written
        ]

    def writing(self, rows: Iterable[QueuedMessage]) -> None:
        """Record that these messages may be on disk from now on."""
        self._written.update(waiting.number for waiting in rows)

    def wrote(self) -> None:
        """Record that the pending messages are on disk; of the tail, keep the ready ones in memory."""
        while self._tail and self._tail[0].number in self._written:
            newest = self._tail.popleft()
            if not self.stored and len(self._ready) < PAGE:
                self._ready.append(newest)
            else:
                self._written.discard(newest.number)
                self.stored.add(newest.number)

    def loaded(self, rows: Iterable[QueuedMessage], end: int) -> None:
        """Take over messages read from disk; those before ``end`` that are missing are lost."""
        wanted = self.stored.take_before(end)
        read = {waiting.number: waiting for waiting in rows if waiting.number in wanted}  # some were dropped meanwhile
        self._ready.extend(read.values())
        self._written.update(read)
        self._lose(len(wanted) - len(read))

    def found(self, runs: NumberRanges) -> int:
        """Take over messages that an earlier run left on disk; they precede all that were not handed out.

        Args:
            runs: Message numbers on disk.

        Returns:
            Offset from the numbers on disk to those of the queue.
        """
        first = self._tail[0].number if self._tail else self.next
        if not runs:
            return -first
        span = runs.end - runs.first
        self._tail = deque(QueuedMessage(waiting.number + span, waiting.message) for waiting in self._tail)
        self.next += span
        self.stored = runs.moved(first - runs.first)
        for _ in range(self.waiting - self.most):
            self._drop_oldest()
        return runs.first - first

    def left(self, runs: NumberRanges) -> None:
        """Keep only the messages in ``runs`` of those that are only on disk; the others are lost."""
        before = len(self.stored)
        self.stored = self.stored.both(runs)
        self._lose(before - len(self.stored))

    def gaps(self) -> list[tuple[int, int]]:
        """Yield ranges of numbers that are not stored and never will be again."""
        kept = [range(waiting.number, waiting.number + 1) for waiting in self._in_memory()]
        gaps, begin = [], LOWEST
        for run in sorted([*kept, *self.stored], key=lambda run: run.start):
            if begin < run.start:
                gaps.append((begin, run.start))
            begin = run.stop
        return [*gaps, (begin, self.next)] if begin < self.next else gaps

    def _in_memory(self) -> Iterator[QueuedMessage]:
        return chain(self.in_flight.values(), self._ready, self._tail)

    def _forget(self, number: int) -> None:
        """Mark a message on disk as no longer needed."""
        if number in self._written:
            self._written.discard(number)
            self.stale = True

    def _lose(self, count: int) -> None:
        """Drop messages that are only on an unreadable disk, and mark what may remain there as not needed."""
        if count:
            self.dropped += count
            self.stale = True

    def _drop_oldest(self) -> None:
        if self._ready:
            self._forget(self._ready.popleft().number)
        elif self.stored:
            self.stored.pop()
            self.stale = True
        elif self._tail:
            self._forget(self._tail.popleft().number)
        else:
            return
        self.dropped += 1
