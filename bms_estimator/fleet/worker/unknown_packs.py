"""Reports of packs that are missing in the table of packs."""

from collections.abc import Iterable

import structlog
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.packs.pack_registry import PackRegistry
from bms_estimator.fleet.worker.partition_lease import PartitionLease

log = structlog.get_logger(__name__)


class UnknownPacks:
    """Reporter of the unknown packs of a worker.

    Args:
        nc: Connection to the tenant's NATS account.
        packs: Table of packs.
    """

    def __init__(self, nc: Client, packs: PackRegistry) -> None:
        self._nc, self._packs = nc, packs
        self._reported: set[str] = set()

    async def publish(self, leases: Iterable[PartitionLease]) -> None:
        """Publish the reason for each pack that has become unknown."""
        unknown = {pack for lease in leases if lease.partition for pack in lease.partition.unknown}
        for pack in unknown - self._reported:
            reason = self._packs.reason(pack)
            log.warning("unknown pack: its blocks are deferred", pack=pack, reason=reason)
            await self._nc.publish(subjects.unknown(pack), reason.encode())
        self._reported = unknown
