"""Latency from bytes to an estimate."""

import math

MIN_S = 1e-5
PER_OCTAVE = 4
BINS = 100
"""Up to five minutes."""


class Latency:
    """A histogram with bins of a fifth each, so that taking a value costs next to nothing."""

    def __init__(self) -> None:
        self._counts = [0] * BINS
        self._most_s = 0.0

    def add(self, latency_s: float) -> None:
        """Take one."""
        octaves = math.log2(max(latency_s, MIN_S) / MIN_S)
        self._counts[min(math.ceil(PER_OCTAVE * octaves), BINS - 1)] += 1
        self._most_s = max(self._most_s, latency_s)

    def take(self) -> tuple[float, float, float] | None:
        """Median, 99th percentile (up to a fifth too long) and longest [s] since the last call.

        None without a sample.
        """
        counts, most_s = self._counts, self._most_s
        self._counts, self._most_s = [0] * BINS, 0.0
        if not any(counts):
            return None
        return _percentile(counts, 0.5, most_s), _percentile(counts, 0.99, most_s), most_s


def _percentile(counts: list[int], share: float, most_s: float) -> float:
    """Return the upper edge of the percentile's bin, or the maximum [s]."""
    wanted, seen = share * sum(counts), 0
    for i, count in enumerate(counts):
        seen += count
        if seen >= wanted:
            return min(MIN_S * math.exp2(i / PER_OCTAVE), most_s)
    return most_s
