"""Ascending numbers, stored as contiguous ranges: the messages of a day usually form one range. Pure."""

from collections import deque
from collections.abc import Iterable, Iterator


class NumberRanges:
    """Ascending queue of numbers, stored as ranges.

    Args:
        runs: Disjoint ranges in ascending order.
    """

    def __init__(self, runs: Iterable[range] = ()) -> None:
        self._runs = deque(run for run in runs if run)
        self._count = sum(map(len, self._runs))

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[range]:
        """Iterate over the ranges."""
        return iter(self._runs)

    def __contains__(self, number: int) -> bool:
        return any(number in run for run in self._runs)

    @property
    def first(self) -> int:
        """The lowest number."""
        return self._runs[0].start

    @property
    def end(self) -> int:
        """The highest number plus one."""
        return self._runs[-1].stop

    def add(self, number: int) -> None:
        """Append a number, which must exceed all others."""
        if self._runs and self._runs[-1].stop == number:
            self._runs[-1] = range(self._runs[-1].start, number + 1)
        else:
            self._runs.append(range(number, number + 1))
        self._count += 1

    def pop(self) -> int:
        """Remove and return the lowest number."""
        run = self._runs.popleft()
        if len(run) > 1:
            self._runs.appendleft(run[1:])
        self._count -= 1
        return run.start

    def take_before(self, end: int) -> "NumberRanges":
        """Remove and return all numbers below ``end``."""
        taken = NumberRanges(range(run.start, min(run.stop, end)) for run in self._runs)
        rest = NumberRanges(range(max(run.start, end), run.stop) for run in self._runs)
        self._runs, self._count = rest._runs, rest._count
        return taken

    def shifted(self, by: int) -> "NumberRanges":
        """Return the ranges with each number increased by ``by``."""
        return NumberRanges(range(run.start + by, run.stop + by) for run in self._runs)

    def intersection(self, other: "NumberRanges") -> "NumberRanges":
        """Return the intersection of two sets of ranges."""
        return NumberRanges(range(max(a.start, b.start), min(a.stop, b.stop)) for a in self._runs for b in other)
