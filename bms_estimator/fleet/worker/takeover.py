"""Takeover of a partition: restoration from its checkpoints, and detection of blocks that kill workers.

A crash or an endless loop in native code gives a worker no chance to report the block. A worker that takes over a partition reads
the stream from the last checkpoint, and therefore processes the block again. The pointer to the checkpoints counts the claims
since the last checkpoint. From claim ``GUARDED_CLAIMS`` on, the worker sends the sequence number of each block of the replay to
the server before it processes the block. If the worker dies, the next owner thereby finds the block that was being processed. A
block that was found ``MAX_DEATHS`` times is lethal, and is skipped.
"""

from contextlib import aclosing

import structlog

from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError
from bms_estimator.fleet.worker.checkpoint.checkpoint_store import CheckpointStore
from bms_estimator.fleet.worker.checkpoint.claims import Claim, ReplayRecord, ReplayRecords
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.fleet.worker.table_in_force import PackLookup, PackSources

GUARDED_CLAIMS = 2
"""Number of claims since the last checkpoint from which a replay is guarded. The replay after the first claim is not guarded,
because a guarded replay waits for the server at each block, and most workers do not die because of a block."""
MAX_DEATHS = 2
"""Number of owners that must die while they process the same block in a guarded replay, before the block counts as lethal."""
MAX_SUSPECTS = 16
"""Maximum number of blocks for which deaths are counted. The newest blocks are kept."""


class ReplayGuard:
    """Guard of the replay of one partition against blocks that kill workers.

    Args:
        records: Records of the replays.
        partition: Number of the partition.

    Attributes:
        end_sequence: Stream sequence number of the last message of the guarded replay; 0 without one.
    """

    def __init__(self, records: ReplayRecords, partition: int) -> None:
        self._records, self._partition = records, partition
        self.end_sequence = 0
        self._deaths: dict[int, int] = {}

    async def begin(self, claim: Claim, end_sequence: int) -> None:
        """Begin the replay after a claim.

        Args:
            claim: Claim of this worker.
            end_sequence: Stream sequence number of the last message of the replay. Later blocks are not guarded.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        self.end_sequence = 0
        if claim.pointer.unsaved_claims < GUARDED_CLAIMS:
            return
        record = await self._records.read(self._partition)
        deaths = dict(record.deaths)
        if record.sequence:
            deaths[record.sequence] = deaths.get(record.sequence, 0) + 1
        self._deaths = {sequence: deaths[sequence] for sequence in sorted(deaths)[-MAX_SUSPECTS:]}
        self.end_sequence = end_sequence

    def is_guarded(self, sequence: int) -> bool:
        """Return True if a block belongs to the guarded replay."""
        return sequence <= self.end_sequence

    async def begin_block(self, sequence: int) -> bool:
        """Return True if a block is lethal; otherwise record on the server that it is being processed.

        Args:
            sequence: Stream sequence number of the block.

        Raises:
            nats.errors.Error: The server does not respond; the block must not be processed.
        """
        is_lethal = self.is_guarded(sequence) and self._deaths.get(sequence, 0) >= MAX_DEATHS
        if self.is_guarded(sequence) and not is_lethal:
            await self._records.deliver(self._partition, ReplayRecord(sequence=sequence, deaths=self._deaths))
        return is_lethal

    async def end_block(self, sequence: int) -> None:
        """Record on the server that a block was processed. The server receives this record before any later one."""
        if self.is_guarded(sequence):
            await self._records.send(self._partition, ReplayRecord(deaths=self._deaths))


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
            except UnreadableFormatError:  # with an earlier checkpoint or none, learned parameters would be lost
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
