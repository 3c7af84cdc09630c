"""Restoration of a partition from its newest usable checkpoint."""

from contextlib import aclosing

import structlog

from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim
from bms_estimator.fleet.worker.checkpoint.format_versions import UnreadableFormatError
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.table_in_force import PackLookup, PackSources

log = structlog.get_logger(__name__)


async def restore_partition(
    checkpoints: CheckpointStore, claim: Claim, number: int, table: PackLookup, sources: PackSources | None
) -> Partition:
    """Return the partition of the newest usable checkpoint; an empty one without a checkpoint.

    Args:
        checkpoints: Store of the checkpoints.
        claim: Claim of this worker.
        number: Number of the partition.
        table: Settings and models of the packs.
        sources: Rows of the same table (``Partition``).

    Raises:
        UnreadableFormatError: The newest intact checkpoint has a format that this version cannot read.
        nats.errors.Error: The server does not respond.
    """
    async with aclosing(checkpoints.load(claim)) as loaded:
        async for checkpoint, data in loaded:
            try:
                partition = Partition.restore(number, table, data, sources=sources)
            except UnreadableFormatError:  # an earlier checkpoint, or none, would lose what was learned
                raise
            except ValueError as error:
                log.warning(
                    "a checkpoint cannot be used: continuing from an earlier one, or from the stream",
                    partition=number,
                    object=checkpoint.object,
                    reason=str(error),
                )
            else:
                log.info("taken over", partition=number, sequence=partition.sequence, bytes=len(data))
                return partition
    log.warning(
        "taken over without a checkpoint, which is right only for a new server: the stream is read from its beginning",
        partition=number,
    )
    return Partition(number, table, sources=sources)
