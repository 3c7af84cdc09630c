"""Where estimates go: MQTT, the console, CSV and Parquet files.

All sinks are peers: async context managers whose ``publish`` neither blocks nor fails.
"""

from collections.abc import Awaitable, Callable, Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from bms_estimator.model.estimate import Snapshot

FRESH_PERIODS = 3
"""Values are stale when no sample was accepted for so many periods of publishing or of sampling, whichever are longer."""

Answer = Callable[[str, Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Answers a request by name and arguments with data. Raises UserError when it cannot be granted."""


class Sink(Protocol):
    """Takes snapshots, once for each publish period."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once and never raises for an outage on the other side."""

    async def __aenter__(self) -> Self:
        """Start."""

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Hand over what is pending and end."""
