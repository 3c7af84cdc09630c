"""State of a board's relay."""

from typing import NamedTuple


class Relay(NamedTuple):
    """Level of the relay pin, until the next reset."""

    high: bool
    """Level now."""
    high_when_silent: bool | None
    """Level after ``silent_s`` without a relay command; None: unchanged."""
    silent_s: int = 0
    """Time without a relay command after which the level changes, 0..3600 [s]."""
