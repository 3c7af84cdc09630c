"""Detection of two publishers on one topic.

MQTT does not identify the publisher of a message. Two publishers are recognized from values and arrival times.
"""

import itertools
from collections import deque
from collections.abc import Sequence
from statistics import median, quantiles
from typing import NamedTuple

MAX_MESSAGES = 64
"""Maximum number of stored messages of a topic."""
MIN_INTERVALS = 8
"""Minimum number of intervals for estimating the usual interval."""
QUICK_FRACTION = 0.5
"""A message is quick if it follows the previous one within this fraction of the usual interval."""
MIN_RETURNS = 4
"""Minimum number of quick returns to an earlier value among the stored messages. Fewer do not show two publishers."""
MAX_INTERVAL_DEVIATION = 0.1
"""Maximum deviation of one publisher's interval from the median of its intervals, as a fraction of the median."""
MIN_RETURN_FRACTION = 0.75
"""Minimum fraction of jumps that return to the previous value. A load that varies at random has fewer."""
MIN_REPEAT_FRACTION = 0.25
"""Minimum fraction of messages without a jump. With fewer, one publisher may be sending only changes."""
MAX_SPREAD = 0.5
"""Largest interquartile range of a publisher's intervals, as a fraction of their median."""
MIN_JUMPS = {"voltage": 0.01, "current": 0.2}
"""Minimum jump between two messages, as a fraction of the larger value, by quantity. Smaller changes count as repeats."""
MAX_RETURN_GAPS = 2.0
"""Time without a return to an earlier value after which the second publisher counts as stopped, as a multiple of the longest
interval between two returns."""
SAME_FRACTION = 0.2
"""Two values belong to one publisher if they differ by less than this fraction of the jump between the two publishers."""


class _Message(NamedTuple):
    """A received message.

    Attributes:
        value: Value of the quantity.
        arrival_s: Arrival time on a monotonic clock [s].
        is_jump: True if the value differs from the previous message's by more than the minimum jump.
        is_back: True if the value jumped back to the value before the last jump.
        is_quick: True if the message arrived sooner than one publisher would publish.
    """

    value: float
    arrival_s: float
    is_jump: bool = False
    is_back: bool = False
    is_quick: bool = False


class PublisherConflict:
    """Detects a second publisher of one quantity on one topic.

    Two publishers with different values make the value jump back and forth, and one of the two jumps arrives sooner
    than one publisher would publish. A load that switches on and off also makes the value jump, but each jump arrives at
    its publisher's usual interval. If the publisher sends only changes, such a load can look like two publishers.
    Therefore values must also repeat, or the jumps must be regular.

    Args:
        min_jump: Minimum difference between the values of two publishers, as a fraction of the larger value.
        interval_s: Expected interval between messages [s].
    """

    def __init__(self, min_jump: float, interval_s: float) -> None:
        self._min_jump, self._interval_s = min_jump, interval_s
        self._messages: deque[_Message] = deque(maxlen=MAX_MESSAGES)
        self._levels: tuple[float, float] | None = None  # values before and after the last jump

    def add(self, value: float, now_s: float) -> bool:
        """Add a value; return True if there are two publishers.

        Args:
            value: Received value.
            now_s: Monotonic clock [s].
        """
        message = _Message(value, now_s)
        if self._messages and self._is_jump(self._messages[-1].value, value):
            before, levels = self._messages[-1], self._levels
            self._levels = before.value, value
            is_back = levels is not None and _is_near(value, levels[0], other=levels[1])
            is_quick = self._is_quick(now_s - before.arrival_s)
            message = _Message(value, now_s, is_jump=True, is_back=is_back, is_quick=is_quick)
        self._messages.append(message)
        return self._has_two_publishers

    @property
    def text(self) -> str:
        """The two values as text."""
        return " and ".join(f"{level:g}" for level in self._levels or ())

    @property
    def _has_two_publishers(self) -> bool:
        jumps = [message for message in self._messages if message.is_jump]
        returns = [message for message in jumps if message.is_back]
        if self._quick_returns() < MIN_RETURNS or len(returns) < MIN_RETURN_FRACTION * len(jumps):
            return False
        if self._messages[-1].arrival_s - returns[-1].arrival_s > MAX_RETURN_GAPS * max(_intervals_s(returns)):
            return False
        repeats = len(self._messages) - len(jumps)
        return repeats >= MIN_REPEAT_FRACTION * len(self._messages) or self._jumps_are_regular(jumps)

    def _quick_returns(self) -> int:
        """Count the intervals of the more frequent value that have its usual length and contain a quick return.

        With two publishers, the more frequent value keeps its regular interval, and the other publisher's messages fall
        into some of these intervals. A single publisher that also sends each change returns to the value between two
        regular messages, so that the interval is shorter than usual.
        """
        messages, levels = list(self._messages), self._levels
        if levels is None:
            return 0
        indices_by_level = [
            [i for i, message in enumerate(messages) if _is_near(message.value, level, other=other)]
            for level, other in (levels, levels[::-1])
        ]
        frequent = max(indices_by_level, key=len)
        pairs = list(itertools.pairwise(frequent))
        usual_interval_s = median([messages[j].arrival_s - messages[i].arrival_s for i, j in pairs] or [0.0])
        return sum(
            any(message.is_back and message.is_quick for message in messages[i + 1 : j + 1])
            and abs(messages[j].arrival_s - messages[i].arrival_s - usual_interval_s)
            < MAX_INTERVAL_DEVIATION * usual_interval_s
            for i, j in pairs
        )

    def _jumps_are_regular(self, jumps: Sequence[_Message]) -> bool:
        """Return True if every second jump arrives at the expected interval or faster, with little spread.

        Jumps alternate between the two values, so that every second jump belongs to one publisher.
        """
        intervals_s = _intervals_s(jumps[::2])
        if len(intervals_s) < MIN_RETURNS:
            return False
        low_s, median_s, high_s = quantiles(intervals_s, n=4)
        return median_s <= self._interval_s and high_s - low_s <= MAX_SPREAD * median_s

    def _is_jump(self, before: float, value: float) -> bool:
        return abs(value - before) > self._min_jump * max(abs(value), abs(before))

    def _is_quick(self, interval_s: float) -> bool:
        """Return True if a message arrived sooner than one publisher would publish.

        The usual interval is the upper quartile, because a second publisher adds short intervals only.
        """
        intervals_s = _intervals_s(self._messages)
        if len(intervals_s) < MIN_INTERVALS:
            return False
        usual_interval_s = quantiles(intervals_s, n=4)[2]
        return interval_s < QUICK_FRACTION * usual_interval_s


def _intervals_s(messages: Sequence[_Message]) -> list[float]:
    return [after.arrival_s - before.arrival_s for before, after in itertools.pairwise(messages)]


def _is_near(value: float, level: float, *, other: float) -> bool:
    """Return True if a value differs from ``level`` by less than ``SAME_FRACTION`` of its distance to ``other``."""
    return abs(value - level) < SAME_FRACTION * abs(other - level)
