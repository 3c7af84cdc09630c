"""Checkpoints of partitions on the server: content in an object store, and a pointer to it in a key-value bucket.

A pointer is replaced by compare-and-set on its revision. A worker that takes over a partition first writes its own name
into the pointer. Therefore the next checkpoint of a slow or suspended former owner fails. An object is written before the
pointer that names it. A pointer also names the next object, so that the next owner finds and removes the object of a
worker that was killed between the two writes.

The first checkpoint of each UTC day is stored for a month. A worker reads it if the newer checkpoints are damaged.
"""

import asyncio
import base64
import hashlib
import io
import json
import time
from collections.abc import AsyncGenerator, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import structlog
from nats.aio.client import Client
from nats.js.api import Header, ObjectInfo
from nats.js.errors import APIError, BadObjectMetaError, KeyNotFoundError, KeyWrongLastSequenceError, NotFoundError
from nats.js.kv import MSG_ROLLUP_SUBJECT, KeyValue
from nats.js.object_store import ObjectStore
from nats.nuid import NUID
from pydantic import BaseModel, ConfigDict, ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.checkpoint_pointer import CheckpointInfo, Pointer, pointer_key
from bms_estimator.fleet.nats.message_erasure import erase_messages
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import UnreadableFormatError, is_readable
from bms_estimator.model.clock import iso_utc

CHECKPOINTS_PER_PARTITION = 2
"""Number of stored checkpoints of a partition: the last checkpoint, and the previous one in case the last is damaged."""
DAILY_CHECKPOINTS = 30
"""Maximum number of stored checkpoints of a partition from different days, besides the last ones."""
DAY_S = 86_400
"""Duration of a day [s]."""
MESSAGE_BYTES = 128 << 10
"""Size of one message of an object [bytes]."""
NO_SPACE = frozenset({10002, 10023, 10047, 10077})
"""Error codes of the server for a full account, server, disk or stream."""
_STREAM = f"OBJ_{subjects.STATES_BUCKET}"

log = structlog.get_logger(__name__)


class FencedError(Exception):
    """Another worker has taken the partition over."""


class ReplayRecord(BaseModel):
    """Progress of a guarded replay of a partition (``replay_guard``)."""

    model_config = ConfigDict(frozen=True)

    sequence: int = 0
    """Stream sequence number of the block that the holder processes; 0: none."""
    deaths: dict[int, int] = {}
    """Number of holders that died while they processed a block, by its stream sequence number."""


class StoredPointer(NamedTuple):
    """Pointer as read from the bucket."""

    revision: int
    pointer: Pointer


@dataclass(frozen=True)
class Claim:
    """Claim of a partition: the pointer that this worker wrote last, and its revision."""

    partition: int
    revision: int
    pointer: Pointer


class CheckpointStore:
    """Checkpoints of one tenant.

    Args:
        nc: Connection to the tenant's NATS account.
        worker: Name of this worker.
        checkpoints: Key-value bucket of the pointers.
        states: Object store of the checkpoints.
    """

    def __init__(self, nc: Client, worker: str, checkpoints: KeyValue, states: ObjectStore) -> None:
        self._nc, self._js, self.worker = nc, nc.jetstream(), worker
        self._checkpoints, self._states = checkpoints, states
        self._object_names = NUID()
        self._last_sent: dict[int, Pointer] = {}  # by partition; its response may have been lost

    async def claim(self, partition: int) -> Claim:
        """Take over a partition from its present owner, if any, and remove its objects that the pointer does not name.

        Such objects remain after a write that a worker did not finish, and after a roll-back to a version that does not
        know daily checkpoints, because such a version leaves them out of the pointer.

        Raises:
            FencedError: Another worker has claimed it at the same time.
            UnreadableFormatError: The last checkpoint has a format that this version cannot read. Nothing was changed.
        """
        stored = await self._read_pointer(partition)
        if stored is None:
            return await self._write_pointer(partition, 0, Pointer())  # revision 0: the key must not exist
        _check_format(stored.pointer)
        # listed before the claim: later objects may be those of a worker that claims the partition next
        objects = await self._stored_objects(partition)
        counted = stored.pointer.model_copy(update={"unsaved_claims": stored.pointer.unsaved_claims + 1})
        claim = await self._write_pointer(partition, stored.revision, counted)
        named = {checkpoint.object for checkpoint in claim.pointer.checkpoints}
        for name in (objects | {stored.pointer.next}) - named:
            await self._remove_object(name)
        return claim

    async def confirm_claim(self, claim: Claim) -> Claim:
        """Read the claim again, because the last write may have succeeded without a response.

        Raises:
            FencedError: Another worker has taken the partition over.
        """
        stored = await self._read_pointer(claim.partition)
        if stored is None or stored.revision <= claim.revision:  # a lower revision comes from a lagging node
            return claim
        if stored.pointer == self._last_sent.get(claim.partition):
            return Claim(claim.partition, stored.revision, stored.pointer)
        raise FencedError(stored.pointer.worker)

    async def end_claim(self, claim: Claim) -> None:
        """Record an orderly release of a partition whose last checkpoint is up to date.

        Raises:
            FencedError: Another worker has taken the partition over.
        """
        if claim.pointer.unsaved_claims:
            pointer = claim.pointer.model_copy(update={"unsaved_claims": 0})
            await self._write_pointer(claim.partition, claim.revision, pointer)

    async def read_replay(self, partition: int) -> ReplayRecord:
        """Return the record of the last guarded replay of a partition."""
        try:
            return ReplayRecord.model_validate_json((await self._checkpoints.get(_replay_key(partition))).value or b"")
        except (KeyNotFoundError, ValidationError):
            return ReplayRecord()

    async def write_replay(self, partition: int, record: ReplayRecord) -> None:
        """Store the record of a guarded replay."""
        await self._checkpoints.put(_replay_key(partition), record.model_dump_json().encode())

    async def send_replay(self, partition: int, record: ReplayRecord) -> None:
        """Send the record of a guarded replay without waiting for its storage."""
        subject = f"$KV.{subjects.CHECKPOINTS_BUCKET}.{_replay_key(partition)}"
        await self._nc.publish(subject, record.model_dump_json().encode())

    async def check_format(self, partition: int) -> None:
        """Check that the last checkpoint of a partition can be read.

        Raises:
            UnreadableFormatError: It has a format that this version cannot read.
        """
        stored = await self._read_pointer(partition)
        if stored is not None:
            _check_format(stored.pointer)

    async def load(self, claim: Claim) -> AsyncGenerator[tuple[CheckpointInfo, bytes], None]:
        """Yield the intact checkpoints, the last ones first; log the damaged ones."""
        for kept in claim.pointer.checkpoints:
            try:
                data = await self._read_object(kept.object)
            except (NotFoundError, BadObjectMetaError):
                data = None
            if data is None:
                log.warning(
                    "a checkpoint is damaged: continuing from an earlier one, or from the stream",
                    partition=claim.partition,
                    object=kept.object,
                    sequence=kept.sequence,
                )
            else:
                yield kept, data

    async def write(self, claim: Claim, sequence: int, chunks: Iterator[bytes], *, file_format: int) -> Claim:
        """Write a checkpoint.

        Args:
            claim: Claim that the last write returned.
            sequence: Stream sequence number of the last included message.
            chunks: Bytes of the checkpoint; iterated in a thread.
            file_format: Format of the bytes.

        Raises:
            FencedError: Another worker has taken the partition over; nothing was changed.
            nats.js.errors.APIError: The server rejects the object. If it lacks space, half of the daily checkpoints
                were removed, so that a later write succeeds.
        """
        claim = await self.confirm_claim(claim)
        pointer = claim.pointer
        try:
            size = await self._write_object(pointer.next, chunks)
        except APIError as error:
            if error.err_code in NO_SPACE and pointer.daily:
                await self._remove_oldest_daily(claim)
            raise
        info = CheckpointInfo(
            sequence=sequence, object=pointer.next, bytes=size, made_s=time.time(), format=file_format
        )
        new_pointer = Pointer(
            kept=(info, *pointer.kept)[:CHECKPOINTS_PER_PARTITION], daily=_with_daily(pointer.daily, info)
        )
        try:
            claim = await self._write_pointer(claim.partition, claim.revision, new_pointer)
        except FencedError:
            await self._remove_object(pointer.next)
            raise
        await self._remove_unreferenced(pointer, new_pointer)
        return claim

    async def replace(self, claim: Claim, old: CheckpointInfo, chunks: Iterator[bytes] | None) -> Claim:
        """Replace a stored checkpoint by one of the same messages, or remove it. The old one is overwritten on the disk.

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
            size = await self._write_object(pointer.next, chunks)
            new = (old.model_copy(update={"object": pointer.next, "bytes": size}),)
        new_pointer = Pointer(kept=_replaced(pointer.kept, old, new), daily=_replaced(pointer.daily, old, new))
        try:
            claim = await self._write_pointer(claim.partition, claim.revision, new_pointer)
        except FencedError:
            await self._remove_object(pointer.next)
            raise
        await erase_messages(self._nc, _STREAM, _chunk_subject(old.object))
        await self._remove_unreferenced(pointer, new_pointer)
        return claim

    async def _remove_oldest_daily(self, claim: Claim) -> None:
        """Remove the older half of the daily checkpoints of a partition, and the unfinished next object."""
        pointer = claim.pointer
        await self._remove_object(pointer.next)  # first, because the new pointer also needs space
        remaining = pointer.model_copy(update={"daily": pointer.daily[: len(pointer.daily) // 2]})
        await self._write_pointer(claim.partition, claim.revision, remaining)
        await self._remove_unreferenced(pointer, remaining)
        log.warning(
            "the server lacks space: daily checkpoints were removed",
            partition=claim.partition,
            removed=len(pointer.daily) - len(remaining.daily),
        )

    async def _remove_unreferenced(self, before: Pointer, after: Pointer) -> None:
        """Remove the objects that a new pointer does not name any more."""
        for old in before.checkpoints:
            if old not in after.checkpoints:
                await self._remove_object(old.object)

    async def _read_pointer(self, partition: int) -> StoredPointer | None:
        """Return the pointer of a partition; None without one.

        Raises:
            UnreadableFormatError: The pointer is not one of this version.
        """
        try:
            entry = await self._checkpoints.get(pointer_key(partition))
        except KeyNotFoundError:
            return None
        try:
            return StoredPointer(entry.revision or 0, Pointer.model_validate_json(entry.value or b""))
        except ValidationError as error:
            raise UnreadableFormatError(0) from error

    async def _write_pointer(self, partition: int, revision: int, pointer: Pointer) -> Claim:
        """Write a pointer with the name of this worker and of its next object.

        Raises:
            FencedError: The stored pointer has another revision.
        """
        next_object = _object_name(partition, self._object_names.next().decode())
        pointer = pointer.model_copy(update={"worker": self.worker, "next": next_object})
        self._last_sent[partition] = pointer
        try:
            data = pointer.model_dump_json().encode()
            return Claim(partition, await self._checkpoints.update(pointer_key(partition), data, revision), pointer)
        except KeyWrongLastSequenceError:
            stored = await self._read_pointer(partition)
            if stored and stored.pointer == pointer:  # the write succeeded, but its response was lost
                return Claim(partition, stored.revision, pointer)
            raise FencedError(stored.pointer.worker if stored else "") from None

    async def _write_object(self, name: str, chunks: Iterator[bytes]) -> int:
        """Write an object and return its size [bytes].

        Unlike ``ObjectStore.put``, the subject of the chunks contains the object's name, so that the chunks of an unfinished
        object can be found and removed.
        """
        subject, digest, size, count = _chunk_subject(name), hashlib.sha256(), 0, 0
        await self._js.purge_stream(_STREAM, subject=subject)  # chunks of an earlier attempt
        reader = io.BufferedReader(_ChunkReader(chunks), MESSAGE_BYTES)
        while message := await asyncio.to_thread(reader.read, MESSAGE_BYTES):
            await self._js.publish(subject, message)
            digest.update(message)
            size, count = size + len(message), count + 1
        info = ObjectInfo(
            name=name,
            bucket=subjects.STATES_BUCKET,
            nuid=name,
            size=size,
            chunks=count,
            digest=_digest(digest.digest()),
            mtime=iso_utc(time.time()),
        )
        metadata = json.dumps(info.as_dict()).encode()
        await self._js.publish(_metadata_subject(name), metadata, headers={Header.ROLLUP: MSG_ROLLUP_SUBJECT})
        return size

    async def _stored_objects(self, partition: int) -> set[str]:
        """Return the names of the objects of a partition, including unfinished ones."""
        filter_subject = _chunk_subject("*")
        found = (await self._js.stream_info(_STREAM, subjects_filter=filter_subject)).state.subjects or {}
        prefix = _chunk_subject(_object_name(partition, ""))
        return {subject.rpartition(".")[2] for subject in found if subject.startswith(prefix)}

    async def _read_object(self, name: str) -> bytes | None:
        """Return the bytes of an object; None if some are missing or the digest differs."""
        info = await self._states.get_info(name)
        subject = f"$O.{subjects.STATES_BUCKET}.C.{info.nuid}"
        last = (await self._js.get_last_msg(_STREAM, subject)).seq or 0
        data = b"".join([message.data async for message in read_messages(self._nc, _STREAM, subject, 1, last)])
        return data if len(data) == info.size and info.digest == _digest(hashlib.sha256(data).digest()) else None

    async def _remove_object(self, name: str) -> None:
        """Remove an object and its metadata, as far as they exist; a deletion marker would keep its name forever."""
        if name:
            for subject in (_metadata_subject(name), _chunk_subject(name)):
                await self._js.purge_stream(_STREAM, subject=subject)


def _check_format(pointer: Pointer) -> None:
    """Raise UnreadableFormatError if the last checkpoint has a format that this version cannot read."""
    if pointer.kept and not is_readable(pointer.kept[0].format):
        raise UnreadableFormatError(pointer.kept[0].format)


def _replaced(
    infos: tuple[CheckpointInfo, ...], old: CheckpointInfo, new: tuple[CheckpointInfo, ...]
) -> tuple[CheckpointInfo, ...]:
    """Return checkpoints with ``new`` in place of ``old``."""
    return tuple(info for each in infos for info in (new if each == old else (each,)))


def _with_daily(daily: tuple[CheckpointInfo, ...], info: CheckpointInfo) -> tuple[CheckpointInfo, ...]:
    """Return the daily checkpoints, with ``info`` added if it is the first one of its day."""
    if any(each.made_s // DAY_S == info.made_s // DAY_S for each in daily):
        return daily
    return (info, *daily)[:DAILY_CHECKPOINTS]


class _ChunkReader(io.RawIOBase):
    """Readable file with the bytes of an iterator."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks = chunks
        self._rest = memoryview(b"")  # unread part of the last chunk

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        while not self._rest:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._rest = memoryview(chunk)
        count = min(len(buffer), len(self._rest))
        buffer[:count] = self._rest[:count]
        self._rest = self._rest[count:]
        return count


def _object_name(partition: int, unique_id: str) -> str:
    """Return the name of a checkpoint in the object store."""
    return f"p{partition}-{unique_id}"


def _chunk_subject(name: str) -> str:
    """Return the subject of an object's chunks."""
    return f"$O.{subjects.STATES_BUCKET}.C.{name}"


def _metadata_subject(name: str) -> str:
    """Return the subject of an object's metadata."""
    return f"$O.{subjects.STATES_BUCKET}.M.{base64.urlsafe_b64encode(name.encode()).decode()}"


def _digest(sha256: bytes) -> str:
    return f"SHA-256={base64.urlsafe_b64encode(sha256).decode()}"


def _replay_key(partition: int) -> str:
    return f"p{partition}.replay"
