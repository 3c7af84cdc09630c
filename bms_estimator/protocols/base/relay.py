"""State of a board's relay."""

from typing import NamedTuple


class Relay(NamedTuple):
    """Level of the relay pin, until the next reset."""

    high: bool
    high_when_silent: bool | None
    """Level once no command of this kind has come for ``silent_s``; None: it stays as it is."""
    silent_s: int = 0
    """0..3600."""
