"""Interface of all live sinks, such as MQTT, terminal and exports."""

from typing import Protocol, Self

from bms_estimator.model.payloads.snapshot import Snapshot


class Sink(Protocol):
    """Sink of snapshots, one for each publish period."""

    def publish(self, snapshot: Snapshot) -> None:
        """Publish a snapshot. The method neither waits for the receiver nor raises an error if the receiver is down."""

    async def __aenter__(self) -> Self:
        """Start publishing; return the sink."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Send queued messages and stop."""
