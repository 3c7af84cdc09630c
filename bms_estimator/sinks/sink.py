"""Where estimates go: MQTT, the console, CSV and Parquet files.

All sinks are peers: async context managers whose ``publish`` neither blocks nor fails.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, Self

from bms_estimator.model.payloads import Snapshot

FRESH_PERIODS = 3
"""Values are stale when no sample was accepted for so many periods of publishing or of sampling, whichever are longer."""


@dataclass
class Delivery:
    """What became of what one pack sends and of what is asked of it, since start; topic ``health`` shows it."""

    drops: int = 0
    """States and events that found no room while the broker was away, or that it refused."""
    waiting: int = 0
    """States and events that the broker has not acknowledged yet."""
    store_trouble: Callable[[], str] = field(default=str, compare=False)
    """Why the disk does not keep what waits, nor the history; empty when it does, or nothing is to be kept."""
    losses: int = 0
    """Connections to a broker that were lost."""
    trouble: str | None = None
    """Why the last one was lost, or a broker could not be reached."""
    refused_topics: list[str] = field(default_factory=list)
    """What the broker denies, as far as it can be told."""
    corrections: int = 0
    """Times somebody else wrote an availability of ours and was put right."""
    requests: Counter[str] = field(default_factory=Counter)
    """By what became of them."""


class Sink(Protocol):
    """Takes snapshots, once for each publish period."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once and never raises for an outage on the other side."""

    async def __aenter__(self) -> Self:
        """Start."""

    async def __aexit__(self, *_: object) -> None:
        """Hand over what is pending and end."""
