"""Checkpoints of partitions on the server: the bytes as objects of their own, and a pointer to them in a key-value bucket.

A pointer is replaced only with knowledge of its last revision. A worker that takes over a partition replaces it at once with its
own name. A slow or suspended former owner then fails to write its next checkpoint. An object is written before the pointer that
names it. A pointer also names the next object, so that the object of a worker killed between the two writes is found and removed.
"""

import asyncio
import base64
import hashlib
import io
import json
import time
from collections.abc import AsyncGenerator, Iterator
from dataclasses import dataclass

import structlog
from nats.aio.client import Client
from nats.js.api import Header, ObjectInfo
from nats.js.errors import BadObjectMetaError, KeyNotFoundError, KeyWrongLastSequenceError, NotFoundError
from nats.js.kv import MSG_ROLLUP_SUBJECT, KeyValue
from nats.js.object_store import ObjectStore
from nats.nuid import NUID
from pydantic import BaseModel, ConfigDict, ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.stored_messages import stored
from bms_estimator.model.clock import iso_utc

KEPT = 2
"""Number of stored checkpoints of a partition: the last, and one before in case the last is damaged."""
PIECE_BYTES = 128 << 10
"""Size of an object's chunk, one message [bytes]."""
_STREAM = f"OBJ_{subjects.STATES_BUCKET}"

log = structlog.get_logger(__name__)


class FencedError(Exception):
    """Another worker has taken the partition over."""


class CheckpointInfo(BaseModel):
    """A checkpoint."""

    model_config = ConfigDict(frozen=True)

    sequence: int
    """Sequence number of the last message of the stream in it."""
    object: str
    """Name in the bucket of states."""
    bytes: int
    made_s: float
    """Wall clock [s since 1970]."""


class Pointer(BaseModel):
    """Entry of a partition in the checkpoint bucket."""

    model_config = ConfigDict(frozen=True)

    worker: str
    """Name of the owning worker."""
    next: str
    """The object that this worker writes next, maybe in part."""
    kept: tuple[CheckpointInfo, ...] = ()
    """The newest first."""


@dataclass(frozen=True)
class Claim:
    """Claim of a partition: the pointer as this worker wrote it."""

    partition: int
    revision: int
    pointer: Pointer


class CheckpointStore:
    """Checkpoints of one tenant.

    Args:
        nc: Connected.
        worker: Our name.
        checkpoints: Bucket of the pointers.
        states: Bucket of the objects.
    """

    def __init__(self, nc: Client, worker: str, checkpoints: KeyValue, states: ObjectStore) -> None:
        self._nc, self._js, self._worker = nc, nc.jetstream(), worker
        self._checkpoints, self._states = checkpoints, states
        self._names = NUID()
        self._tried: dict[int, Pointer] = {}  # last written checkpoint by partition, possibly without a response

    async def claim(self, partition: int) -> Claim:
        """Take a partition over, whoever had it.

        Raises:
            FencedError: Another worker does it at the same time.
        """
        found = await self._look(partition)
        revision, before = found or (0, None)
        kept = before.kept if before else ()
        claim = await self._replace(partition, revision, kept)
        if before:
            await self._remove(before.next)
        return claim

    async def confirm_claim(self, claim: Claim) -> Claim:
        """Read the claim again, because the last write may have succeeded without a response.

        Raises:
            FencedError: Another worker has taken the partition over.
        """
        found = await self._look(claim.partition)
        if found is None or found[0] <= claim.revision:  # less: of a node that is behind
            return claim
        if found[1] == self._tried.get(claim.partition):
            return Claim(claim.partition, *found)
        raise FencedError(found[1].worker)

    async def load(self, claim: Claim) -> AsyncGenerator[tuple[CheckpointInfo, bytes], None]:
        """Yield the readable checkpoints, the newest first; log why others are not readable."""
        for kept in claim.pointer.kept:
            try:
                data = await self._read(kept.object)
            except (NotFoundError, BadObjectMetaError):
                data = None
            if data is None:
                log.warning(
                    "a checkpoint is damaged: going on from what was before",
                    partition=claim.partition,
                    object=kept.object,
                    sequence=kept.sequence,
                )
            else:
                yield kept, data

    async def write(self, claim: Claim, sequence: int, chunks: Iterator[bytes]) -> Claim:
        """Write a checkpoint.

        Args:
            claim: As the last write left it.
            sequence: Stream sequence of the last included message.
            chunks: Bytes of the checkpoint; taken in a thread.

        Raises:
            FencedError: Another worker has taken the partition over; nothing was changed.
        """
        claim = await self.confirm_claim(claim)
        pointer = claim.pointer
        size = await self._put(pointer.next, chunks)
        made = CheckpointInfo(sequence=sequence, object=pointer.next, bytes=size, made_s=time.time())
        kept = (made, *pointer.kept)
        try:
            claim = await self._replace(claim.partition, claim.revision, kept[:KEPT])
        except FencedError:
            await self._remove(pointer.next)
            raise
        for old in kept[KEPT:]:
            await self._remove(old.object)
        return claim

    async def _look(self, partition: int) -> tuple[int, Pointer] | None:
        try:
            entry = await self._checkpoints.get(_key(partition))
        except KeyNotFoundError:
            return None
        try:
            return entry.revision or 0, Pointer.model_validate_json(entry.value or b"")
        except ValidationError as error:
            log.warning("what points to a checkpoint cannot be read", partition=partition, reason=str(error))
            return entry.revision or 0, Pointer(worker="", next="")

    async def _replace(self, partition: int, revision: int, kept: tuple[CheckpointInfo, ...]) -> Claim:
        pointer = Pointer(worker=self._worker, next=f"p{partition}-{self._names.next().decode()}", kept=kept)
        self._tried[partition] = pointer
        try:
            data = pointer.model_dump_json().encode()
            return Claim(partition, await self._checkpoints.update(_key(partition), data, revision), pointer)
        except KeyWrongLastSequenceError:
            found = await self._look(partition)
            if found and found[1] == pointer:  # it was written, and the answer lost
                return Claim(partition, found[0], pointer)
            raise FencedError(found[1].worker if found else "") from None

    async def _put(self, name: str, chunks: Iterator[bytes]) -> int:
        """Write an object; how many bytes it has.

        As ``ObjectStore.put`` does, but for where the pieces are: under the object's name, so that those of one that was never
        finished are found.
        """
        subject, digest, size, count = _pieces(name), hashlib.sha256(), 0, 0
        await self._js.purge_stream(_STREAM, subject=subject)  # of an attempt before
        reader = io.BufferedReader(_Chunks(chunks), PIECE_BYTES)
        while piece := await asyncio.to_thread(reader.read, PIECE_BYTES):
            await self._js.publish(subject, piece)
            digest.update(piece)
            size, count = size + len(piece), count + 1
        info = ObjectInfo(
            name=name,
            bucket=subjects.STATES_BUCKET,
            nuid=name,
            size=size,
            chunks=count,
            digest=_digest(digest.digest()),
            mtime=iso_utc(time.time()),
        )
        described = json.dumps(info.as_dict()).encode()
        await self._js.publish(_described(name), described, headers={Header.ROLLUP: MSG_ROLLUP_SUBJECT})
        return size

    async def _read(self, name: str) -> bytes | None:
        """Return the bytes of an object; None if some are missing or the digest differs."""
        info = await self._states.get_info(name)
        subject = f"$O.{subjects.STATES_BUCKET}.C.{info.nuid}"
        last = (await self._js.get_last_msg(_STREAM, subject)).seq or 0
        data = b"".join([message.data async for message in stored(self._nc, _STREAM, subject, 1, last)])
        return data if len(data) == info.size and info.digest == _digest(hashlib.sha256(data).digest()) else None

    async def _remove(self, name: str) -> None:
        """Remove an object and its metadata, as far as they exist; a deletion marker would keep its name forever."""
        if name:
            for subject in (_described(name), _pieces(name)):
                await self._js.purge_stream(_STREAM, subject=subject)


class _Chunks(io.RawIOBase):
    """Bytes in pieces as a file."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks, self._rest = chunks, memoryview(b"")

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


def _pieces(name: str) -> str:
    """Return the subject of an object's chunks."""
    return f"$O.{subjects.STATES_BUCKET}.C.{name}"


def _described(name: str) -> str:
    """Return the subject of an object's metadata."""
    return f"$O.{subjects.STATES_BUCKET}.M.{base64.urlsafe_b64encode(name.encode()).decode()}"


def _digest(sha256: bytes) -> str:
    return f"SHA-256={base64.urlsafe_b64encode(sha256).decode()}"


def _key(partition: int) -> str:
    return f"p{partition}"
