"""Delivery statistics of one pack's messages and requests."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class DeliveryStats:
    """Counters of a pack's sent messages and received requests since start; topic ``health`` publishes them."""

    drops: int = 0
    """States and events dropped because the queue was full or the broker rejected them."""
    waiting: int = 0
    """States and events that the broker has not acknowledged yet."""
    store_trouble: Callable[[], str] = field(default=str, compare=False)
    """Function that returns the reason for which queued messages and history cannot be stored. The reason is empty if
    they can be stored, and without a database."""
    losses: int = 0
    """Number of lost connections."""
    trouble: str | None = None
    """Reason for the lost or failed connection; None while connected, and before the first attempt."""
    refused_topics: list[str] = field(default_factory=list)
    """Topics that the broker denies, as far as it reports denials."""
    corrections: int = 0
    """Availability messages of other clients that were corrected."""
    requests: Counter[str] = field(default_factory=Counter)
    """Number of requests by result."""
