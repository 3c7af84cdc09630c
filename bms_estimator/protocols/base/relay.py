"""State of a board's relay."""

from typing import NamedTuple


class Relay(NamedTuple):
    """Level of the relay pin, until the next reset."""

    high: bool
    high_when_silent: bool | None
    """Level after ``silent_s`` without a command of this kind; None: it stays as it is."""
    silent_s: int = 0
    """0..3600."""
