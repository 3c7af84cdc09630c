"""Claims of partitions by workers: pointers to checkpoints, which are replaced by compare-and-set on their revision.

A worker that takes over a partition first writes its own name into the pointer. Therefore the next checkpoint of a slow or
suspended former owner fails.
"""

import asyncio
from dataclasses import dataclass
from typing import NamedTuple

import structlog
from nats.aio.client import Client
from nats.js.errors import KeyNotFoundError, KeyWrongLastSequenceError
from nats.js.kv import KeyValue
from nats.nuid import NUID
from pydantic import BaseModel, ConfigDict, ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointPointer, pointer_key
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError, is_readable
from bms_estimator.fleet.worker.checkpoint.checkpoint_objects import object_name

log = structlog.get_logger(__name__)


RECEIPT_TIMEOUT_S = 2
"""Timeout of the server's response to the flush of a record [s]."""


class ReplayRecord(BaseModel):
    """Progress of a guarded replay of a partition."""

    model_config = ConfigDict(frozen=True)

    sequence: int = 0
    """Stream sequence number of the block that the owner of the partition processes; 0: none."""
    deaths: dict[int, int] = {}
    """Number of owners that died while they processed a block, by its stream sequence number."""


class ReplayRecords:
    """Stored records of guarded replays.

    Args:
        nc: Connection to the tenant's NATS account.
        bucket: Key-value bucket of the records.
    """

    def __init__(self, nc: Client, bucket: KeyValue) -> None:
        self._nc, self._bucket = nc, bucket

    async def read(self, partition: int) -> ReplayRecord:
        """Return the record of the last guarded replay of a partition."""
        try:
            return ReplayRecord.model_validate_json((await self._bucket.get(_key(partition))).value or b"")
        except (KeyNotFoundError, ValidationError):
            return ReplayRecord()

    async def deliver(self, partition: int, record: ReplayRecord) -> None:
        """Send the record of a guarded replay, and wait until the server has received it.

        The function does not wait until the record is stored. While no node leads the stream, it would wait at the first block of
        the replay, and the end of the worker would count as a death in this block.
        """
        await self.send(partition, record)
        await asyncio.sleep(0)  # lets a task of nats-py write the record before the flush writes a ping
        # nats-py stops reading from the connection when the response to a cancelled flush arrives
        await asyncio.shield(self._nc.flush(RECEIPT_TIMEOUT_S))

    async def send(self, partition: int, record: ReplayRecord) -> None:
        """Send the record of a guarded replay."""
        subject = f"$KV.{subjects.CHECKPOINTS_BUCKET}.{_key(partition)}"
        await self._nc.publish(subject, record.model_dump_json().encode())


def _key(partition: int) -> str:
    return f"p{partition}.replay"


class FencedError(Exception):
    """Another worker has taken the partition over."""


class StoredPointer(NamedTuple):
    """Pointer as read from the bucket."""

    revision: int
    pointer: CheckpointPointer


@dataclass(frozen=True)
class Claim:
    """Claim of a partition: the pointer that this worker wrote last, and its revision."""

    partition: int
    revision: int
    pointer: CheckpointPointer


class Claims:
    """Claims of one worker.

    Args:
        worker: Name of the worker.
        bucket: Key-value bucket of the pointers.
    """

    def __init__(self, worker: str, bucket: KeyValue) -> None:
        self._worker, self._bucket = worker, bucket
        self._object_names = NUID()
        self._last_sent: dict[
            int, CheckpointPointer
        ] = {}  # by partition; the pointer may be stored although no response arrived

    async def check_format(self, partition: int) -> None:
        """Check that the last checkpoint of a partition can be read.

        Raises:
            UnreadableFormatError: The checkpoint has a format that this version cannot read.
        """
        await self.read(partition)

    async def read(self, partition: int) -> StoredPointer | None:
        """Return the pointer of a partition; None without one.

        Raises:
            UnreadableFormatError: This version cannot decode the pointer, or the last checkpoint has a format that this version
                cannot read.
        """
        stored = await self._read(partition)
        if stored and stored.pointer.kept and not is_readable(stored.pointer.kept[0].format):
            raise UnreadableFormatError(stored.pointer.kept[0].format)
        return stored

    async def confirm(self, claim: Claim) -> Claim:
        """Read the claim again, because the last write may have succeeded without a response.

        If the server has lost its data, the result claims a partition without a checkpoint, so that the worker saves its state.

        Raises:
            FencedError: Another worker has taken the partition over.
        """
        stored = await self._read(claim.partition)
        if stored is None and await self._is_bucket_recreated(claim):
            log.error("the server has lost its checkpoints: the state is saved again", partition=claim.partition)
            return Claim(claim.partition, 0, CheckpointPointer(worker=self._worker, next=claim.pointer.next))
        if stored is None or stored.revision <= claim.revision:  # a lower revision comes from a lagging node
            return claim
        if stored.pointer == self._last_sent.get(claim.partition):
            return Claim(claim.partition, stored.revision, stored.pointer)
        raise FencedError(stored.pointer.worker)

    async def _is_bucket_recreated(self, claim: Claim) -> bool:
        """Return True if the bucket was recreated, so that it ends before the revision of a claim."""
        state = (await self._bucket.status()).stream_info.state
        return bool(claim.revision > state.last_seq)

    async def record_release(self, claim: Claim) -> None:
        """Record an orderly release of a partition whose last checkpoint is up to date.

        Raises:
            FencedError: Another worker has taken the partition over.
        """
        if claim.pointer.unsaved_claims:
            pointer = claim.pointer.model_copy(update={"unsaved_claims": 0})
            await self.write(claim.partition, claim.revision, pointer)

    async def write(self, partition: int, revision: int, pointer: CheckpointPointer) -> Claim:
        """Write a pointer with the name of this worker and of its next object.

        Args:
            partition: Number of the partition.
            revision: Revision of the pointer to replace; 0 if none exists.
            pointer: New pointer.

        Raises:
            FencedError: The stored pointer has another revision.
        """
        next_object = object_name(partition, self._object_names.next().decode())
        pointer = pointer.model_copy(update={"worker": self._worker, "next": next_object})
        self._last_sent[partition] = pointer
        try:
            data = pointer.model_dump_json().encode()
            return Claim(partition, await self._bucket.update(pointer_key(partition), data, revision), pointer)
        except KeyWrongLastSequenceError:
            stored = await self._read(partition)
            if stored and stored.pointer == pointer:  # the write succeeded, but its response was lost
                return Claim(partition, stored.revision, pointer)
            raise FencedError(stored.pointer.worker if stored else "") from None

    async def _read(self, partition: int) -> StoredPointer | None:
        """Return the pointer of a partition; None without one.

        Raises:
            UnreadableFormatError: This version cannot decode the pointer.
        """
        try:
            entry = await self._bucket.get(pointer_key(partition))
        except KeyNotFoundError:
            return None
        try:
            return StoredPointer(entry.revision or 0, CheckpointPointer.model_validate_json(entry.value or b""))
        except ValidationError as error:
            raise UnreadableFormatError(0) from error
