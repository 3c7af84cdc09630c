"""Numbers in ascending order, stored as runs without a gap: a day of them is one run. Pure."""

from collections import deque
from collections.abc import Iterable, Iterator


class NumberRanges:
    """Numbers that are taken at the front and put at the back.

    Args:
        runs: Each after the one before.
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
        """One after the highest."""
        return self._runs[-1].stop

    def add(self, number: int) -> None:
        """Put the highest number."""
        if self._runs and self._runs[-1].stop == number:
            self._runs[-1] = range(self._runs[-1].start, number + 1)
        else:
            self._runs.append(range(number, number + 1))
        self._count += 1

    def pop(self) -> int:
        """Take the lowest number."""
        run = self._runs.popleft()
        if len(run) > 1:
            self._runs.appendleft(run[1:])
        self._count -= 1
        return run.start

    def take_before(self, end: int) -> "NumberRanges":
        """Take all that are below ``end``."""
        taken = NumberRanges(range(run.start, min(run.stop, end)) for run in self._runs)
        rest = NumberRanges(range(max(run.start, end), run.stop) for run in self._runs)
        self._runs, self._count = rest._runs, rest._count
        return taken

    def moved(self, by: int) -> "NumberRanges":
        """Return the ranges with each number increased by ``by``."""
        return NumberRanges(range(run.start + by, run.stop + by) for run in self._runs)

    def both(self, other: "NumberRanges") -> "NumberRanges":
        """Return the intersection of two sets of ranges."""
        return NumberRanges(range(max(a.start, b.start), min(a.stop, b.stop)) for a in self._runs for b in other)
