"""Checkpoints of partitions on the server: content in an object store, and a pointer to it in a key-value bucket.

An object is written before the pointer that names it. A pointer also names the next object, so that the next owner finds and
removes the object of a worker that was killed between the two writes.

The first checkpoint of each UTC day is stored for a month. A worker reads it if the newer checkpoints are damaged.

If all packs send blocks between two saves, each checkpoint is whole. If few do, an increment contains only the packs that were
changed since the last save, so that its size is nearly proportional to their number.
"""

import time
from collections.abc import AsyncGenerator, Iterator

import structlog
from nats.aio.client import Client
from nats.js.errors import APIError
from nats.js.kv import KeyValue
from nats.js.object_store import ObjectStore

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, CheckpointPointer
from bms_estimator.fleet.nats.stream_sizes import DAILY_CHECKPOINTS
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import INCREMENT_FORMAT, PartitionCheckpoint
from bms_estimator.fleet.worker.checkpoint.checkpoint_objects import CheckpointObjects
from bms_estimator.fleet.worker.checkpoint.claims import Claim, Claims, FencedError, ReplayRecords

MAX_INCREMENTS = 32
"""Maximum number of increments of a checkpoint, which limits the number of objects."""
MAX_INCREMENT_FRACTION = 0.5
"""Maximum total size of the increments of a checkpoint, as a fraction of the size of the whole checkpoint before them."""
DAY_S = 86_400
"""Duration of a day [s]."""


def next_increment(
    checkpoint: PartitionCheckpoint, pointer: CheckpointPointer, *, file_format: int, now_s: float
) -> PartitionCheckpoint | None:
    """Return the increment to write after the last checkpoint; None if a whole checkpoint must be written.

    Args:
        checkpoint: Whole checkpoint of the partition.
        pointer: Pointer to the stored checkpoints.
        file_format: Format in which the checkpoint is written.
        now_s: Wall clock [s since 1970].
    """
    if checkpoint.changed is None or file_format < INCREMENT_FORMAT or not pointer.kept:
        return None
    last = pointer.kept[0]
    if last.format != file_format or len(last.increments) >= MAX_INCREMENTS or not has_daily(pointer.daily, now_s):
        return None
    increment = checkpoint.to_increment(len(last.increments) + 1)
    size = last.increment_bytes + sum(map(len, increment.packs.values()))
    return increment if size <= MAX_INCREMENT_FRACTION * last.bytes else None


def with_increment(pointer: CheckpointPointer, sequence: int, size: int, now_s: float) -> CheckpointPointer:
    """Return a pointer with the next object as an increment of the last checkpoint.

    Args:
        pointer: Present pointer.
        sequence: Stream sequence number of the last message that the increment includes.
        size: Size of the increment [bytes].
        now_s: Wall clock [s since 1970].
    """
    last, *earlier = pointer.kept
    update = {
        "sequence": sequence,
        "made_s": now_s,
        "increments": (*last.increments, pointer.next),
        "increment_bytes": last.increment_bytes + size,
    }
    return CheckpointPointer(kept=(last.model_copy(update=update), *earlier), daily=pointer.daily)


def has_daily(daily: tuple[CheckpointInfo, ...], now_s: float) -> bool:
    """Return True if a checkpoint of the present UTC day is among the daily ones."""
    return any(each.made_s // DAY_S == now_s // DAY_S for each in daily)


CHECKPOINTS_PER_PARTITION = 2
"""Number of stored checkpoints of a partition: the last checkpoint, and the previous one in case the last is damaged."""
NO_SPACE_CODES = frozenset({10002, 10023, 10047, 10077})
"""Error codes of the server for a full account, server, disk or stream."""

log = structlog.get_logger(__name__)


class CheckpointStore:
    """Checkpoints of one tenant.

    Args:
        nc: Connection to the tenant's NATS account.
        worker: Name of this worker.
        checkpoints: Key-value bucket of the pointers.
        states: Object store of the checkpoints.

    Attributes:
        claims: Claims of this worker.
        replays: Records of guarded replays.
    """

    def __init__(self, nc: Client, worker: str, checkpoints: KeyValue, states: ObjectStore) -> None:
        self.worker = worker
        self.claims, self.replays = Claims(worker, checkpoints), ReplayRecords(nc, checkpoints)
        self._objects = CheckpointObjects(nc, states)
        self._damaged: set[str] = set()  # names of damaged objects that this worker has found

    async def claim(self, partition: int) -> Claim:
        """Take over a partition from its present owner, if any. Remove objects of the partition that the pointer does not name.

        Such objects remain after an unfinished write, and after a roll-back to a version that drops daily checkpoints or
        increments from the pointer.

        Raises:
            FencedError: Another worker has claimed the partition at the same time.
            UnreadableFormatError: The last checkpoint has a format that this version cannot read. Nothing was changed.
        """
        stored = await self.claims.read(partition)
        if stored is None:
            return await self.claims.write(partition, 0, CheckpointPointer())  # revision 0: the key must not exist
        # listed before the claim, because the next owner may write objects after it
        objects = await self._objects.names(partition)
        new_pointer = stored.pointer.model_copy(update={"unsaved_claims": stored.pointer.unsaved_claims + 1})
        claim = await self.claims.write(partition, stored.revision, new_pointer)
        for name in (objects | {stored.pointer.next}) - claim.pointer.objects:
            await self._objects.remove(name)
        return claim

    async def load(self, claim: Claim) -> AsyncGenerator[tuple[CheckpointInfo, bytes], None]:
        """Yield the intact checkpoints, the last ones first; log the damaged ones.

        If an increment is damaged, the objects before it are the checkpoint of an earlier save.
        """
        for info in claim.pointer.checkpoints:
            data = await self.read(info)
            if self.is_damaged(info):
                log.warning(
                    "a checkpoint is damaged: continuing from an earlier one, or from the stream",
                    partition=claim.partition,
                    object=next(name for name in info.objects if name in self._damaged),
                    sequence=info.sequence,
                )
            if data:
                yield info, data

    async def read(self, info: CheckpointInfo) -> bytes:
        """Return the bytes of a checkpoint up to the first damaged object."""
        intact: list[bytes] = []
        for name in info.objects:
            data = await self._objects.read(name)
            if data is None:
                self._damaged.add(name)
                break
            intact.append(data)
        return b"".join(intact)

    def is_damaged(self, info: CheckpointInfo) -> bool:
        """Return True if this worker has found an object of a checkpoint damaged."""
        return not self._damaged.isdisjoint(info.objects)

    async def write(self, claim: Claim, checkpoint: PartitionCheckpoint, *, file_format: int) -> Claim:
        """Write a checkpoint, or only the changed packs if ``next_increment`` permits.

        Args:
            claim: Claim that the last write returned.
            checkpoint: Whole checkpoint.
            file_format: Format of the bytes.

        Raises:
            FencedError: Another worker has taken the partition over; nothing was changed.
            nats.js.errors.APIError: The server rejects the object. If it lacks space, half of the daily checkpoints
                were removed, so that a later write succeeds.
        """
        claim = await self.claims.confirm(claim)
        pointer, now_s = claim.pointer, time.time()
        increment = next_increment(checkpoint, pointer, file_format=file_format, now_s=now_s)
        try:
            size = await self._objects.write(pointer.next, (increment or checkpoint).chunks(file_format))
        except APIError as error:
            if error.err_code in NO_SPACE_CODES and pointer.daily:
                await self._remove_oldest_daily(claim)
            raise
        if increment:
            new_pointer = with_increment(pointer, checkpoint.sequence, size, now_s)
        else:
            new_pointer = self._with_whole(pointer, _whole_info(claim, checkpoint, size, file_format))
        return await self._replace_pointer(claim, new_pointer)

    async def replace(self, claim: Claim, old: CheckpointInfo, chunks: Iterator[bytes] | None) -> Claim:
        """Replace a stored checkpoint by a whole one with the same sequence number, or remove it.

        Objects that no other checkpoint needs are overwritten on the disk.

        Args:
            claim: Claim that the last write returned.
            old: Checkpoint to replace.
            chunks: Bytes of the new checkpoint; None: remove the old one.

        Raises:
            FencedError: A worker has taken the partition over; the old checkpoint remains.
        """
        pointer = claim.pointer
        new: tuple[CheckpointInfo, ...] = ()
        if chunks is not None:
            size = await self._objects.write(pointer.next, chunks)
            whole = {"object": pointer.next, "bytes": size, "increments": (), "increment_bytes": 0}
            new = (old.model_copy(update=whole),)
        new_pointer = CheckpointPointer(
            kept=_replaced(pointer.kept, old, new), daily=_replaced(pointer.daily, old, new)
        )
        return await self._replace_pointer(claim, new_pointer, erase=True)

    async def replace_last(self, claim: Claim, checkpoint: PartitionCheckpoint, *, file_format: int) -> Claim:
        """Write a whole checkpoint in place of the last ones. The daily ones remain.

        Args:
            claim: Claim that the last write returned.
            checkpoint: Whole checkpoint.
            file_format: Format of the bytes.

        Raises:
            FencedError: A worker has taken the partition over; its checkpoints remain.
        """
        size = await self._objects.write(claim.pointer.next, checkpoint.chunks(file_format))
        info = _whole_info(claim, checkpoint, size, file_format)
        return await self._replace_pointer(claim, CheckpointPointer(kept=(info,), daily=claim.pointer.daily))

    def _with_whole(self, pointer: CheckpointPointer, info: CheckpointInfo) -> CheckpointPointer:
        """Return a pointer with a whole checkpoint added. The oldest one and damaged ones are left out."""
        intact = (each for each in pointer.kept if each.object not in self._damaged)
        daily = pointer.daily if has_daily(pointer.daily, info.made_s) else (info, *pointer.daily)[:DAILY_CHECKPOINTS]
        return CheckpointPointer(kept=(info, *intact)[:CHECKPOINTS_PER_PARTITION], daily=daily)

    async def _remove_oldest_daily(self, claim: Claim) -> None:
        """Remove the older half of the daily checkpoints of a partition, and the unfinished next object."""
        pointer = claim.pointer
        await self._objects.remove(pointer.next)  # first, because the new pointer also needs space
        remaining = pointer.model_copy(update={"daily": pointer.daily[: len(pointer.daily) // 2]})
        await self._replace_pointer(claim, remaining)
        log.warning(
            "the server lacks space: daily checkpoints were removed",
            partition=claim.partition,
            removed=len(pointer.daily) - len(remaining.daily),
        )

    async def _replace_pointer(self, claim: Claim, new: CheckpointPointer, *, erase: bool = False) -> Claim:
        """Replace a pointer, and remove the objects that the new one does not name any more.

        Args:
            claim: Claim of this worker.
            new: New pointer.
            erase: Overwrite the removed objects on the disk.

        Raises:
            FencedError: Another worker has taken the partition over; the next object was removed.
        """
        try:
            new_claim = await self.claims.write(claim.partition, claim.revision, new)
        except FencedError:
            await self._objects.remove(claim.pointer.next)
            raise
        for name in claim.pointer.objects - new.objects:
            await (self._objects.erase(name) if erase else self._objects.remove(name))
        return new_claim


async def open_checkpoints(nc: Client, worker: str) -> CheckpointStore:
    """Return the checkpoints of a tenant.

    Args:
        nc: Connection to the tenant's NATS account.
        worker: Name with which partitions are claimed.
    """
    js = nc.jetstream()
    checkpoints = await js.key_value(subjects.CHECKPOINTS_BUCKET)
    return CheckpointStore(nc, worker, checkpoints, await js.object_store(subjects.STATES_BUCKET))


def _whole_info(claim: Claim, checkpoint: PartitionCheckpoint, size: int, file_format: int) -> CheckpointInfo:
    """Return the metadata of a whole checkpoint in the next object of a claim."""
    return CheckpointInfo(
        sequence=checkpoint.sequence, object=claim.pointer.next, bytes=size, made_s=time.time(), format=file_format
    )


def _replaced(
    infos: tuple[CheckpointInfo, ...], old: CheckpointInfo, new: tuple[CheckpointInfo, ...]
) -> tuple[CheckpointInfo, ...]:
    """Return checkpoints with ``new`` in place of ``old``."""
    return tuple(info for each in infos for info in (new if each == old else (each,)))
