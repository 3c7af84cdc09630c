"""Delays before retries."""

import random

FIRST_RETRY_S = 0.5
"""First retry delay of a missing or lost port; it doubles with each attempt [s]."""

MAX_RETRY_S = 10.0
"""Maximum retry delay of a missing or lost port [s]."""
FIRST_DELAY_S = 2.0
"""First delay of a ``Backoff``; it doubles with each attempt [s]."""
MAX_DELAY_S = 30.0
"""Maximum delay of a ``Backoff`` [s]. A local broker is usually unavailable for a short time only."""


class Backoff:
    """Increasing delays with jitter, so that not all clients of a broker reconnect at the same time.

    Args:
        first_s: First delay [s].
        max_s: Maximum delay [s].
    """

    def __init__(self, first_s: float = FIRST_DELAY_S, max_s: float = MAX_DELAY_S) -> None:
        self._first_s = self._next_s = first_s
        self._max_s = max_s

    def next_s(self) -> float:
        """Return the next delay [s]."""
        delay_s = self._next_s
        self._next_s = min(2.0 * delay_s, self._max_s)
        return delay_s * random.uniform(0.5, 1.0)

    def reset(self) -> None:
        """Restart with the first delay after a success."""
        self._next_s = self._first_s
