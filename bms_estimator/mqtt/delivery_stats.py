"""Delivery statistics of one pack's messages and requests."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class DeliveryStats:
    """Counters of a pack's sent messages and received requests since start; topic ``health`` publishes them."""

    drops: int = 0
    """States and events that found no room while the broker was away, or that it refused."""
    waiting: int = 0
    """States and events that the broker has not acknowledged yet."""
    store_trouble: Callable[[], str] = field(default=str, compare=False)
    """Why the disk does not keep what waits, nor the history; empty if it can be written, or nothing is to be
    stored."""
    losses: int = 0
    """Connections to a broker that were lost."""
    trouble: str | None = None
    """Why the last one was lost, or a broker could not be reached."""
    refused_topics: list[str] = field(default_factory=list)
    """Topics that the broker denies, as far as it reports them."""
    corrections: int = 0
    """Availability messages of other clients that were corrected."""
    requests: Counter[str] = field(default_factory=Counter)
    """Number of requests by result."""
