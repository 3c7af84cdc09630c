"""Streams and buckets of a tenant that a worker needs."""

from typing import NamedTuple

from nats.aio.client import Client
from nats.js.errors import NotFoundError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import require_partitions
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore, open_checkpoints
from bms_estimator.model.errors import UserError


class TenantStores(NamedTuple):
    """Stores of a tenant."""

    partitions: int
    """Total number of partitions."""
    checkpoints: CheckpointStore
    bucket: PackBucket
    """Table of packs."""


async def open_stores(nc: Client, worker: str) -> TenantStores:
    """Open the buckets and read the table of packs.

    Args:
        nc: Connection to the tenant's NATS account.
        worker: Name of the worker.

    Raises:
        UserError: A stream is missing.
    """
    partitions = await require_partitions(nc)
    try:
        await nc.jetstream().stream_info(subjects.FITS_STREAM)
    except NotFoundError:
        raise UserError(
            f"the server has no stream {subjects.FITS_STREAM}: upgrade and restart `bms-estimator fleet serve` before the workers"
        ) from None
    checkpoints = await open_checkpoints(nc, worker)
    bucket = PackBucket(nc)
    await bucket.refresh()
    return TenantStores(partitions, checkpoints, bucket)
