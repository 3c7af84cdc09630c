"""Objects of checkpoints in the object store ``states``.

Unlike with ``ObjectStore.put``, the subject of an object's chunks contains the object's name. Therefore the chunks of an
unfinished object can be found and removed.
"""

import asyncio
import base64
import hashlib
import json
import time
from collections.abc import Iterator

from nats.aio.client import Client
from nats.js.api import Header, ObjectInfo
from nats.js.errors import BadObjectMetaError, NotFoundError
from nats.js.kv import MSG_ROLLUP_SUBJECT
from nats.js.object_store import ObjectStore

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.message_erasure import erase_messages
from bms_estimator.fleet.nats.stored_messages import read_messages
from bms_estimator.model.clock import iso_utc

MESSAGE_BYTES = 128 << 10
"""Maximum size of one message of an object [bytes]."""
_STREAM = f"OBJ_{subjects.STATES_BUCKET}"


class CheckpointObjects:
    """Objects of one tenant.

    Args:
        nc: Connection to the tenant's NATS account.
        states: Object store of the checkpoints.
    """

    def __init__(self, nc: Client, states: ObjectStore) -> None:
        self._nc, self._js, self._states = nc, nc.jetstream(), states

    async def write(self, name: str, chunks: Iterator[bytes]) -> int:
        """Write an object and return its size [bytes].

        Args:
            name: Name of the object (``object_name``). Chunks of an earlier attempt are removed.
            chunks: Bytes of the object; iterated in a thread.

        Raises:
            nats.js.errors.APIError: The server rejects the object.
        """
        subject, digest, size, count = _chunk_subject(name), hashlib.sha256(), 0, 0
        await self._js.purge_stream(_STREAM, subject=subject)
        while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
            digest.update(chunk)
            for first in range(0, len(chunk), MESSAGE_BYTES):
                await self._js.publish(subject, chunk[first : first + MESSAGE_BYTES])
                count += 1
            size += len(chunk)
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

    async def read(self, name: str) -> bytes | None:
        """Return the bytes of an object; None if some are missing or the digest differs."""
        try:
            info = await self._states.get_info(name)
            subject = f"$O.{subjects.STATES_BUCKET}.C.{info.nuid}"
            last = (await self._js.get_last_msg(_STREAM, subject)).seq or 0
        except (NotFoundError, BadObjectMetaError):
            return None
        data = b"".join([message.data async for message in read_messages(self._nc, _STREAM, subject, 1, last)])
        return data if len(data) == info.size and info.digest == _digest(hashlib.sha256(data).digest()) else None

    async def names(self, partition: int) -> set[str]:
        """Return the names of the objects of a partition, including unfinished ones."""
        filter_subject = _chunk_subject("*")
        found = (await self._js.stream_info(_STREAM, subjects_filter=filter_subject)).state.subjects or {}
        prefix = _chunk_subject(object_name(partition, ""))
        return {subject.rpartition(".")[2] for subject in found if subject.startswith(prefix)}

    async def remove(self, name: str) -> None:
        """Remove an object and its metadata, as far as they exist; a deletion marker would keep its name forever."""
        if name:
            for subject in (_metadata_subject(name), _chunk_subject(name)):
                await self._js.purge_stream(_STREAM, subject=subject)

    async def erase(self, name: str) -> None:
        """Remove an object, and let the server overwrite its bytes on the disk."""
        await erase_messages(self._nc, _STREAM, _chunk_subject(name))
        await self.remove(name)


def object_name(partition: int, unique_id: str) -> str:
    """Return the name of an object of a partition."""
    return f"p{partition}-{unique_id}"


def _chunk_subject(name: str) -> str:
    """Return the subject of an object's chunks."""
    return f"$O.{subjects.STATES_BUCKET}.C.{name}"


def _metadata_subject(name: str) -> str:
    """Return the subject of an object's metadata."""
    return f"$O.{subjects.STATES_BUCKET}.M.{base64.urlsafe_b64encode(name.encode()).decode()}"


def _digest(sha256: bytes) -> str:
    return f"SHA-256={base64.urlsafe_b64encode(sha256).decode()}"
