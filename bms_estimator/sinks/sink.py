"""Sinks of estimates: MQTT, terminal, CSV and Parquet files.

All sinks are peers: async context managers with a ``publish`` that neither blocks nor fails.
"""

from typing import Protocol, Self

from bms_estimator.model.payloads import Snapshot


class Sink(Protocol):
    """Takes snapshots, once for each publish period."""

    def publish(self, snapshot: Snapshot) -> None:
        """Take a snapshot; returns at once and never raises for an outage on the other side."""

    async def __aenter__(self) -> Self:
        """Start."""

    async def __aexit__(self, *_: object) -> None:
        """Hand over queued messages and end."""
