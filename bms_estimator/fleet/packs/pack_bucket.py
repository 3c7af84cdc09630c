"""Table of packs on the server: one row per pack in the bucket ``packs``, cell files in the bucket ``cells``."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import nats.errors
import nats.js.errors
import structlog
from nats.aio.client import Client
from nats.js.errors import KeyWrongLastSequenceError

from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.nats.bucket_reader import BucketReader, read_bucket, stream_of, subject_of
from bms_estimator.fleet.nats.stream_reader import RESPONSE_TIMEOUT_S, StreamError
from bms_estimator.fleet.packs.pack_registry import PackRegistry

POLL_S = 1.0
"""Poll interval for changes [s]."""
MAX_PENDING = 2000
"""Maximum number of written rows that wait for the server's acknowledgment."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class WriteCounts:
    """Numbers of rows by the effect of a write."""

    new: int
    changed: int
    same: int
    removed: int
    left: int
    """Number of rows that stay in the bucket although they are not among the written values."""


class PackBucket:
    """Copy of the table, updated by polling. A pack whose row has an error is unknown; no error is raised.

    Args:
        nc: Connection to the tenant's NATS account.

    Attributes:
        packs: Registry of the packs.
        faults: Number of failed reads.
        fault: Reason for the last failed read; empty after a successful read.
    """

    def __init__(self, nc: Client) -> None:
        self._nc, self.packs = nc, PackRegistry()
        self.faults, self.fault = 0, ""
        self._readers = {bucket: BucketReader(nc, bucket) for bucket in (CELLS_BUCKET, PACKS_BUCKET)}
        self._changed: dict[str, set[str]] = {PACKS_BUCKET: set(), CELLS_BUCKET: set()}

    async def refresh(self) -> set[str]:
        """Read the changes since the last call, and return the affected packs. The first call reads everything.

        Raises:
            StreamError: The server does not respond, or has no such bucket. The next call includes what was read.
        """
        await self._read(CELLS_BUCKET, self.packs.set_cell)  # before the rows that name the cells
        await self._read(PACKS_BUCKET, self.packs.set_row)
        changed = self._changed[PACKS_BUCKET] | self.packs.packs_using(self._changed[CELLS_BUCKET])
        self._changed = {PACKS_BUCKET: set(), CELLS_BUCKET: set()}
        return changed

    async def _read(self, bucket: str, set_value: Callable[[str, bytes | None], bool]) -> None:
        def set_and_record(key: str, data: bytes | None) -> None:
            if set_value(key, data):
                self._changed[bucket].add(key)

        await self._readers[bucket].read(set_and_record)

    async def follow(self, on_change: Callable[[set[str]], None]) -> None:
        """Poll for changes until cancelled; call ``on_change`` with the packs whose row or cell has changed.

        A failed poll is counted, and the next one includes its changes. If the server has lost the table, it is written again.
        """
        while True:
            await asyncio.sleep(POLL_S)
            try:
                if packs := await self.refresh():
                    on_change(packs)
                await self._write_lost()
            except (StreamError, nats.errors.Error) as error:
                self.faults, self.fault = self.faults + 1, str(error)
                continue
            self.fault = ""

    async def _write_lost(self) -> None:
        """Write the values that the server has lost, unless another process has written or removed them since.

        Raises:
            StreamError: The server does not respond or rejects the request. The next call repeats the write.
        """
        for bucket, values in ((CELLS_BUCKET, self.packs.cell_files), (PACKS_BUCKET, self.packs.rows)):
            if lost := self._readers[bucket].lost & values.keys():
                await put_new(self._nc, bucket, {key: values[key] for key in lost})
                log.error("the server has lost the table of packs: it is written again", bucket=bucket, rows=len(lost))
            self._readers[bucket].lost.clear()


async def write_bucket(nc: Client, bucket: str, values: Mapping[str, bytes], *, remove: bool = False) -> WriteCounts:
    """Write the values that differ from those in a bucket.

    Args:
        nc: Connection to the tenant's NATS account.
        bucket: Name of the bucket.
        values: Values by key.
        remove: True to remove entries that are not in ``values``.

    Raises:
        StreamError: The server does not respond or rejects the request.
    """
    stored = await read_bucket(nc, bucket)
    differing = {key: data for key, data in values.items() if stored.get(key) != data}
    others = stored.keys() - values.keys()
    await put(nc, bucket, differing)
    if remove:
        await remove_keys(nc, bucket, others)
    new, removed = len(differing.keys() - stored.keys()), len(others) if remove else 0
    return WriteCounts(
        new=new,
        changed=len(differing) - new,
        same=len(values) - len(differing),
        removed=removed,
        left=len(others) - removed,
    )


async def remove_keys(nc: Client, bucket: str, keys: Collection[str]) -> None:
    """Remove keys from a bucket.

    Raises:
        StreamError: The server does not respond or rejects the request.
    """
    await put(nc, bucket, dict.fromkeys(keys, b""), {"KV-Operation": "DEL"})


async def purge_keys(nc: Client, bucket: str, keys: Collection[str]) -> None:
    """Remove keys and their deletion markers from a bucket. Readers of the bucket then read it from its beginning.

    Raises:
        nats.js.errors.APIError: The server rejects the request.
    """
    for key in keys:
        await nc.jetstream().purge_stream(stream_of(bucket), subject=subject_of(bucket, key))


async def put(
    nc: Client, bucket: str, values: Mapping[str, bytes], headers: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write values by key, up to ``MAX_PENDING`` at a time.

    Raises:
        StreamError: The server does not respond or rejects the request.
    """
    js, entries = nc.jetstream(), list(values.items())
    try:
        for first in range(0, len(entries), MAX_PENDING):
            acks = [
                await js.publish_async(subject_of(bucket, key), data, headers=dict(headers) or None)
                for key, data in entries[first : first + MAX_PENDING]
            ]
            async with asyncio.timeout(RESPONSE_TIMEOUT_S):
                await asyncio.gather(*acks)
    except (TimeoutError, nats.errors.Error, nats.js.errors.Error) as error:
        raise StreamError(f"the server does not store rows of {bucket}: {error}") from None


async def put_new(nc: Client, bucket: str, values: Mapping[str, bytes]) -> None:
    """Write the values of keys that the bucket lacks. Keys that exist or are marked as removed do not change.

    Raises:
        StreamError: The server does not respond or rejects the request.
    """
    try:
        key_value, entries = await nc.jetstream().key_value(bucket), list(values.items())
        for first in range(0, len(entries), MAX_PENDING):
            writes = (key_value.update(key, data, 0) for key, data in entries[first : first + MAX_PENDING])
            for result in await asyncio.gather(*writes, return_exceptions=True):
                if isinstance(result, BaseException) and not isinstance(result, KeyWrongLastSequenceError):
                    raise result
    except (TimeoutError, nats.errors.Error) as error:
        raise StreamError(f"the server does not store rows of {bucket}: {error}") from None
