"""State of a node of the server and of its tenants, from which the metrics are made."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from bms_estimator.fleet.heartbeat import Heartbeat


@dataclass(frozen=True)
class StreamState:
    """Stored messages of a stream or bucket.

    Attributes:
        messages: Number of messages.
        stored_bytes: Size of the messages [bytes].
        max_bytes: Size at which the oldest messages are removed, or new ones rejected [bytes]; None: unlimited.
    """

    messages: int
    stored_bytes: int
    max_bytes: int | None = None


class Problems(NamedTuple):
    """Numbers of packs in the table that need attention."""

    silent: int
    """Packs without a summary for the time ``tenant_watch.SILENT_S``."""
    alarms: int
    """Packs with the alarm weak_cell or cell_short at the end of the last hour."""


@dataclass(frozen=True)
class TenantState:
    """Workers and streams of a tenant.

    Attributes:
        heartbeats: Last heartbeat of each live worker.
        undelivered: Number of undelivered messages by partition; None: the server does not answer.
        streams: Streams and buckets by name; None: the server does not answer.
        unsaved_share: Part of the stream ``RAW`` that no checkpoint includes (``unsaved_blocks``); None before the first check.
        problems: Numbers of packs without a recent summary, and with alarms in the last one; None before the first check.
    """

    heartbeats: tuple[Heartbeat, ...] = ()
    undelivered: Mapping[int, int] | None = None
    streams: Mapping[str, StreamState] | None = None
    unsaved_share: float | None = None
    problems: Problems | None = None

    @property
    def unowned(self) -> frozenset[int] | None:
        """Partitions with undelivered messages that no live worker owns; None: unknown."""
        if self.undelivered is None:
            return None
        owned = {number for heartbeat in self.heartbeats for number in heartbeat.partitions}
        return frozenset(number for number, count in self.undelivered.items() if count and number not in owned)

    @property
    def refused(self) -> frozenset[int]:
        """Partitions that a worker refuses and no worker owns."""
        refused = {each.partition for heartbeat in self.heartbeats for each in heartbeat.refused}
        return frozenset(refused.difference(*(heartbeat.partitions for heartbeat in self.heartbeats)))


@dataclass(frozen=True)
class NodeState:
    """One node of the server.

    Attributes:
        is_healthy: True if the monitor reports that the node and its streams are available.
        varz: Response of the monitor to ``varz``; empty: no response.
        disk_bytes, disk_free_bytes: Size and free space of the file system of the streams [bytes].
    """

    is_healthy: bool = False
    varz: Mapping[str, object] = field(default_factory=dict)
    disk_bytes: int | None = None
    disk_free_bytes: int | None = None

    def monitored(self, *path: str) -> float | None:
        """Return a number of the monitor's response; None without it."""
        value: object = self.varz
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        return float(value) if isinstance(value, int | float) else None
