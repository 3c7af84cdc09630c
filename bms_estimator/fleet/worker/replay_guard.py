"""Detection of blocks that kill workers, during the replay of a partition whose last owners have died.

A crash or an endless loop in native code gives a worker no chance to report the block. A worker that takes over a partition
reads the stream from the last checkpoint, and therefore processes the block again. The claim counts the claims since the
last checkpoint. From the claim number ``GUARDED_CLAIMS`` on, the worker stores the sequence number of each block of the replay on
the server before it processes the block. If the worker dies, the next owner thereby finds the block that was being processed. A
block that was found ``MAX_DEATHS`` times is lethal, and is skipped.
"""

from bms_estimator.fleet.worker.checkpoint.claims import Claim
from bms_estimator.fleet.worker.checkpoint.replay_records import ReplayRecord, ReplayRecords

GUARDED_CLAIMS = 2
"""Number of claims since the last checkpoint from which a replay is guarded. The replay after the first claim is not guarded,
because a guarded replay waits for the server at each block, and most workers do not die because of a block."""
MAX_DEATHS = 2
"""Number of owners that must die while they process the same block in a guarded replay, until the block is lethal."""
MAX_SUSPECTS = 16
"""Maximum number of blocks for which deaths are counted. The newest blocks are kept."""


class ReplayGuard:
    """Guard of one partition.

    Args:
        records: Records of the replays.
        partition: Number of the partition.
    """

    def __init__(self, records: ReplayRecords, partition: int) -> None:
        self._records, self._partition = records, partition
        self._end_sequence = 0
        self._deaths: dict[int, int] = {}

    async def begin(self, claim: Claim, end_sequence: int) -> None:
        """Begin the replay after a claim.

        Args:
            claim: Claim of this worker.
            end_sequence: Stream sequence number of the last message of the replay. Later blocks are not guarded.

        Raises:
            nats.errors.Error: The server does not respond.
        """
        self._end_sequence = 0
        if claim.pointer.unsaved_claims < GUARDED_CLAIMS:
            return
        record = await self._records.read(self._partition)
        deaths = dict(record.deaths)
        if record.sequence:
            deaths[record.sequence] = deaths.get(record.sequence, 0) + 1
        self._deaths = {sequence: deaths[sequence] for sequence in sorted(deaths)[-MAX_SUSPECTS:]}
        self._end_sequence = end_sequence

    def is_guarded(self, sequence: int) -> bool:
        """Return True if a block belongs to the guarded replay."""
        return sequence <= self._end_sequence

    async def is_lethal(self, sequence: int) -> bool:
        """Return True if a block is lethal; otherwise store on the server that it is being processed.

        Args:
            sequence: Stream sequence number of the block.

        Raises:
            nats.errors.Error: The server does not respond; the block must not be processed.
        """
        if not self.is_guarded(sequence):
            return False
        if self._deaths.get(sequence, 0) >= MAX_DEATHS:
            return True
        await self._records.write(self._partition, ReplayRecord(sequence=sequence, deaths=self._deaths))
        return False

    async def end_block(self, sequence: int) -> None:
        """Store on the server that a block was processed. The server receives this record before any later one."""
        if self.is_guarded(sequence):
            await self._records.send(self._partition, ReplayRecord(deaths=self._deaths))
