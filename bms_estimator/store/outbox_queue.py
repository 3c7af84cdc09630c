"""Order of queued messages, in memory and on disk. The module itself accesses no disk.

From the oldest to the newest, messages are ``in_flight`` (sent and not acknowledged), ready to be sent, ``stored`` (on
disk only), or in the tail. New messages enter the tail. While no message is stored, messages are sent from the tail.
Messages on disk are listed by their numbers in contiguous ranges, because those of a day usually form one range.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

from bms_estimator.mqtt.connection import Message, OnResult, QueuedMessage


class NumberRanges:
    """Ascending queue of numbers, stored as ranges.

    Args:
        ranges: Disjoint ranges in ascending order.
    """

    def __init__(self, ranges: Iterable[range] = ()) -> None:
        self._ranges = deque(each for each in ranges if each)
        self._count = sum(map(len, self._ranges))

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[range]:
        """Iterate over the ranges."""
        return iter(self._ranges)

    def __contains__(self, number: int) -> bool:
        return any(number in each for each in self._ranges)

    @property
    def first(self) -> int:
        """The lowest number."""
        return self._ranges[0].start

    @property
    def end(self) -> int:
        """The highest number plus one."""
        return self._ranges[-1].stop

    def add(self, number: int) -> None:
        """Append a number, which must exceed all others."""
        if self._ranges and self._ranges[-1].stop == number:
            self._ranges[-1] = range(self._ranges[-1].start, number + 1)
        else:
            self._ranges.append(range(number, number + 1))
        self._count += 1

    def remove(self, number: int) -> None:
        """Remove a number, which must be present."""
        i = next(i for i, each in enumerate(self._ranges) if number in each)
        whole = self._ranges[i]
        del self._ranges[i]
        for part in (range(number + 1, whole.stop), range(whole.start, number)):
            if part:
                self._ranges.insert(i, part)
        self._count -= 1

    def take_before(self, end: int) -> "NumberRanges":
        """Remove and return all numbers below ``end``."""
        taken = NumberRanges(range(each.start, min(each.stop, end)) for each in self._ranges)
        rest = NumberRanges(range(max(each.start, end), each.stop) for each in self._ranges)
        self._ranges, self._count = rest._ranges, rest._count
        return taken

    def shifted(self, by: int) -> "NumberRanges":
        """Return the ranges with each number increased by ``by``."""
        return NumberRanges(range(each.start + by, each.stop + by) for each in self._ranges)

    def intersection(self, other: "NumberRanges") -> "NumberRanges":
        """Return the intersection of two sets of ranges."""
        return NumberRanges(range(max(a.start, b.start), min(a.stop, b.stop)) for a in self._ranges for b in other)


MAX_TAIL = 4096
"""Maximum number of messages in the tail, which grows while the disk cannot be written. The states of an hour, one each
second, take some megabytes."""
PAGE = 1000
"""Maximum number of ready messages. The next page is read from disk once fewer than half of them are left."""

MIN_NUMBER = -(1 << 62)
"""Number below all others, here and on disk."""


@dataclass
class OutboxQueue:
    """Queue of numbered messages.

    Attributes:
        max_messages: Maximum number of queued messages. Beyond this number, the oldest message that is not in flight is dropped.
        on_result: Callbacks of the messages whose result is awaited, by number. These messages are dropped last.
        dropped: Number of dropped and lost messages.
        next_number: Number of the next message.
        in_flight: Messages that were taken and are not acknowledged yet.
        has_stale_rows: True if the disk may contain messages that are no longer queued.
        disk_state_known: True if the content of the disk is known; if not, the messages in memory are written again.
        stored: Numbers of the messages that are on disk only.
        skip_disk: True to take messages of the tail before stored ones, because the disk cannot be read.
    """

    max_messages: int
    on_result: dict[int, OnResult] = field(default_factory=dict)
    dropped: int = 0
    next_number: int = 0
    in_flight: dict[int, QueuedMessage] = field(default_factory=dict)
    has_stale_rows: bool = False
    disk_state_known: bool = True
    skip_disk: bool = False
    stored: NumberRanges = field(default_factory=NumberRanges)
    _ready: deque[QueuedMessage] = field(default_factory=deque)
    _tail: deque[QueuedMessage] = field(default_factory=deque)
    _written: set[int] = field(default_factory=set)  # numbers of messages in memory that are also on disk

    @property
    def waiting(self) -> int:
        """Number of messages that are not acknowledged."""
        return len(self.in_flight) + len(self._ready) + len(self.stored) + len(self._tail)

    @property
    def oldest(self) -> int | None:
        """Lowest number of a message that is not acknowledged; None if the queue is empty."""
        if self.stored and not self.in_flight and not self._ready:
            return self.stored.first
        return next((queued.number for queued in self._in_memory()), None)

    @property
    def can_take(self) -> bool:
        """True if ``take_next`` returns a message."""
        return bool(self._ready or (self._tail and (self.skip_disk or not self.stored)))

    @property
    def needs_page(self) -> bool:
        """True if the next page should be read from disk."""
        return bool(self.stored) and len(self._ready) < PAGE // 2

    def put(self, message: Message, on_result: OnResult | None = None) -> None:
        """Append a message. ``on_result`` receives its result."""
        if on_result:
            self.on_result[self.next_number] = on_result
        self._tail.append(QueuedMessage(self.next_number, message))
        self.next_number += 1
        if self.waiting > self.max_messages:
            self._drop_oldest()
        if len(self._tail) > MAX_TAIL:
            self._drop_oldest(only_tail=True)

    def take_next(self, max_count: int) -> list[QueuedMessage]:
        """Return up to ``max_count`` of the oldest messages in memory, which are then in flight."""
        taken: list[QueuedMessage] = []
        while len(taken) < max_count and self.can_take:
            taken.append((self._ready or self._tail).popleft())
        self.in_flight |= {queued.number: queued for queued in taken}
        return taken

    def acknowledge(self, number: int, rejection: str = "") -> None:
        """Record that a message is acknowledged, or the reason why it is permanently rejected."""
        if self.in_flight.pop(number, None):
            self._forget(number)
            self._report(number, rejection)

    def rewind(self) -> None:
        """Make the messages in flight ready again."""
        self._ready.extendleft(reversed(self.in_flight.values()))
        self.in_flight.clear()

    def unwritten(self) -> list[QueuedMessage]:
        """Return the messages that are in memory only."""
        return [
            queued for queued in self._in_memory() if not self.disk_state_known or queued.number not in self._written
        ]

    def mark_writing(self, rows: Iterable[QueuedMessage]) -> None:
        """Record that messages may be on disk from now on."""
        self._written.update(queued.number for queued in rows)

    def mark_written(self) -> None:
        """Move the written messages out of the tail: they become ready up to a page, and stored beyond it."""
        while self._tail and self._tail[0].number in self._written:
            oldest = self._tail.popleft()
            if not self.stored and len(self._ready) < PAGE:
                self._ready.append(oldest)
            else:
                self._written.discard(oldest.number)
                self.stored.add(oldest.number)

    def add_page(self, rows: Iterable[QueuedMessage], end: int) -> None:
        """Make messages read from disk ready. Stored messages before ``end`` that are not among ``rows`` are lost."""
        wanted = self.stored.take_before(end)
        # the page may contain messages that were dropped while it was read
        read = {queued.number: queued for queued in rows if queued.number in wanted}
        self._ready.extend(read.values())
        self._written.update(read)
        self._count_lost(wanted, read)

    def prepend_backlog(self, ranges: NumberRanges) -> int:
        """Insert messages that an earlier run left on disk before all messages of this run.

        Args:
            ranges: Message numbers on disk.

        Returns:
            Number of a message on disk minus its number in the queue.
        """
        # before the backlog is read no message is taken, so that all messages of this run are in the tail
        first = self._tail[0].number if self._tail else self.next_number
        if not ranges:
            return -first  # in an empty table, numbers begin at 0
        span = ranges.end - ranges.first
        self._tail = deque(QueuedMessage(queued.number + span, queued.message) for queued in self._tail)
        self.on_result = {number + span: on_result for number, on_result in self.on_result.items()}
        self.next_number += span
        self.stored = ranges.shifted(first - ranges.first)
        for _ in range(self.waiting - self.max_messages):
            self._drop_oldest()
        return ranges.first - first

    def retain_stored(self, ranges: NumberRanges) -> None:
        """Remove the stored messages that are not in ``ranges``, and count them as lost."""
        before, self.stored = self.stored, self.stored.intersection(ranges)
        self._count_lost(before, self.stored)

    def gaps(self) -> list[tuple[int, int]]:
        """Return ranges of numbers that are no longer queued, as half-open intervals."""
        in_memory = [range(queued.number, queued.number + 1) for queued in self._in_memory()]
        gaps, begin = [], MIN_NUMBER
        for numbers in sorted([*in_memory, *self.stored], key=lambda each: each.start):
            if begin < numbers.start:
                gaps.append((begin, numbers.start))
            begin = numbers.stop
        return [*gaps, (begin, self.next_number)] if begin < self.next_number else gaps

    def _in_memory(self) -> Iterator[QueuedMessage]:
        return chain(self.in_flight.values(), self._ready, self._tail)

    def _forget(self, number: int) -> None:
        """Record that the disk contains a message that is no longer queued, if it was written."""
        if number in self._written:
            self._written.discard(number)
            self.has_stale_rows = True

    def _report(self, number: int, reason: str) -> None:
        """Pass the result of a message to its callback, if it has one."""
        if on_result := self.on_result.pop(number, None):
            on_result(reason)

    def _count_lost(self, stored: NumberRanges, remaining: Collection[int] | NumberRanges) -> None:
        """Count the stored messages that do not remain. Their rows may still exist and are deleted later."""
        if count := len(stored) - len(remaining):
            self.dropped += count
            self.has_stale_rows = True
        for number in [each for each in self.on_result if each in stored and each not in remaining]:
            self._report(number, "lost because the disk is damaged")

    def _drop_oldest(self, *, only_tail: bool = False) -> None:
        """Drop the oldest message that is not in flight, if possible one whose result is not awaited."""
        number = next((each for each in self._droppable(only_tail) if each not in self.on_result), None)
        if number is None:
            number = next(self._droppable(only_tail), None)
        if number is None:
            return
        if number in self.stored:
            self.stored.remove(number)
            self.has_stale_rows = True
        for messages in (self._ready, self._tail):
            if dropped := next((each for each in messages if each.number == number), None):
                messages.remove(dropped)
                self._forget(number)
                break
        self.dropped += 1
        self._report(number, "dropped because the queue is full")

    def _droppable(self, only_tail: bool) -> Iterator[int]:
        """Iterate over the numbers of the messages that are not in flight, the oldest first."""
        if not only_tail:
            yield from (queued.number for queued in self._ready)
            yield from chain.from_iterable(self.stored)
        yield from (queued.number for queued in self._tail)
