"""Ascending numbers, stored as contiguous ranges. The messages of a day usually form one range. No I/O."""

from collections import deque
from collections.abc import Iterable, Iterator


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
