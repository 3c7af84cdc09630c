"""Progress of a calculation, as a fraction of its work."""

from collections.abc import Callable

Progress = Callable[[float], None]
"""Function that a calculation calls with the finished fraction of its work, 0..1, any number of times."""


def no_progress(_: float) -> None:
    """Ignore the progress."""


class WorkCounter:
    """Progress of a calculation that consists of parts of different sizes.

    Args:
        progress: Receives the finished fraction of the whole calculation.
        total: Size of all parts together, in any unit.
    """

    def __init__(self, progress: Progress, total: float) -> None:
        self._progress, self._total, self._begun = progress, total, 0.0

    def part(self, size: float) -> Progress:
        """Begin the next part. Return the function that receives the finished fraction of this part."""
        before = self._begun
        self._begun += size
        return lambda fraction: self._progress(min((before + fraction * size) / self._total, 1.0))
