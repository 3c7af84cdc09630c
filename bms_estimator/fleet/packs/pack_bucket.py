"""The table of packs on the server: one row for each in the bucket ``packs``, cell files in the bucket ``cells``."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import nats.errors
import nats.js.errors
from nats.aio.client import Client

from bms_estimator.edge.subjects import CELLS_BUCKET, PACKS_BUCKET
from bms_estimator.fleet.nats.connection import error_text
from bms_estimator.fleet.nats.stream_reader import ANSWER_S, Stored, StreamError, read_stream
from bms_estimator.fleet.packs.pack_registry import PackRegistry

POLL_S = 1.0
"""Poll interval for changes [s]."""
AT_ONCE = 2000
"""Maximum number of written rows waiting for the server's acknowledgment."""
_GONE = frozenset({"DEL", "PURGE"})


@dataclass(frozen=True)
class Written:
    """Result of a table change: numbers of rows."""

    new: int
    changed: int
    same: int
    removed: int
    left: int
    """Number of rows in the bucket that are not among the values."""


class PackBucket:
    """The table as a worker sees it; never an error for its content.

    Args:
        nc: Connected as the tenant.

    Attributes:
        packs: Known packs, as a function of the name.
        faults: Number of times that the server could not be read.
        fault: Why, the last time; empty while it can.
    """

    def __init__(self, nc: Client) -> None:
        self.packs = PackRegistry()
        self.faults, self.fault = 0, ""
        self._nc = nc
        self._next = {PACKS_BUCKET: 1, CELLS_BUCKET: 1}
        self._changed: dict[str, set[str]] = {PACKS_BUCKET: set(), CELLS_BUCKET: set()}

    async def refresh(self) -> set[str]:
        """Read changes, at first everything; returns the affected packs.

        Raises:
            StreamError: The server does not answer, or has no such bucket.
        """
        await self._read(CELLS_BUCKET, self.packs.set_cell)  # a row finds its cell
        await self._read(PACKS_BUCKET, self.packs.set_row)
        changed = self._changed[PACKS_BUCKET] | self.packs.made_of(self._changed[CELLS_BUCKET])
        self._changed = {PACKS_BUCKET: set(), CELLS_BUCKET: set()}
        return changed

    async def _read(self, bucket: str, take: Callable[[str, bytes | None], bool]) -> None:
        """Collect the changed keys of a bucket, also for the next refresh if this one fails."""
        try:
            state = (await self._nc.jetstream().stream_info(_stream(bucket))).state
        except nats.errors.Error as error:
            raise StreamError(f"the server refuses to read {_stream(bucket)}: {error_text(error)}") from None
        if state.last_seq + 1 < self._next[bucket]:
            self._next[bucket] = 1  # re-created, or its end is lost: sequence numbers restart with other values
        async for batch in read_stream(self._nc, _stream(bucket), _key(bucket, ">"), first=self._next[bucket]):
            for message in batch:
                key, data = _entry(bucket, message)
                if take(key, data):
                    self._changed[bucket].add(key)
            self._next[bucket] = batch[-1].sequence + 1

    async def follow(self, changed: Callable[[set[str]], None]) -> None:
        """Follow changes without end; call ``changed`` with the packs whose row or cell has changed.

        Missing values are requested again.
        """
        while True:
            await asyncio.sleep(POLL_S)
            try:
                news = await self.refresh()
            except (StreamError, nats.errors.Error) as error:
                self.faults, self.fault = self.faults + 1, str(error)
                continue
            self.fault = ""
            if news:
                changed(news)


async def read_bucket(nc: Client, bucket: str) -> dict[str, bytes]:
    """All values by their keys.

    Raises:
        StreamError: The server does not answer, or has no such bucket.
    """
    found = dict[str, bytes]()
    async for batch in read_stream(nc, _stream(bucket), _key(bucket, ">")):
        for message in batch:
            key, data = _entry(bucket, message)
            if data is None:
                found.pop(key, None)
            else:
                found[key] = data
    return found


async def write_bucket(nc: Client, bucket: str, values: Mapping[str, bytes], *, remove: bool = False) -> Written:
    """Let a bucket hold ``values``; unchanged values are not written.

    Args:
        nc: Connected.
        bucket: Name of the bucket.
        values: Values by key.
        remove: Remove entries that are not in ``values``.

    Raises:
        StreamError: The server does not answer, or refuses.
    """
    held = await read_bucket(nc, bucket)
    differing = {key: data for key, data in values.items() if held.get(key) != data}
    others = held.keys() - values.keys()
    await put(nc, bucket, differing)
    if remove:
        await remove_keys(nc, bucket, others)
    new, removed = len(differing.keys() - held.keys()), len(others) if remove else 0
    return Written(new, len(differing) - new, len(values) - len(differing), removed, len(others) - removed)


async def remove_keys(nc: Client, bucket: str, keys: Collection[str]) -> None:
    """Take keys out of a bucket.

    Raises:
        StreamError: The server does not answer, or refuses.
    """
    await put(nc, bucket, dict.fromkeys(keys, b""), {"KV-Operation": "DEL"})


async def put(
    nc: Client, bucket: str, values: Mapping[str, bytes], headers: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write values by key, many at a time.

    Raises:
        StreamError: The server does not answer, or refuses.
    """
    js, entries = nc.jetstream(), list(values.items())
    try:
        for first in range(0, len(entries), AT_ONCE):
            acks = [
                await js.publish_async(_key(bucket, key), data, headers=dict(headers) or None)
                for key, data in entries[first : first + AT_ONCE]
            ]
            async with asyncio.timeout(ANSWER_S):
                await asyncio.gather(*acks)
    except (TimeoutError, nats.errors.Error, nats.js.errors.Error) as error:
        raise StreamError(f"the server does not take what is written to {bucket}: {error}") from None


def _entry(bucket: str, message: Stored) -> tuple[str, bytes | None]:
    """Key and value; None: it is there no more."""
    gone = message.headers.get("KV-Operation") in _GONE or "Nats-Marker-Reason" in message.headers
    return message.subject.removeprefix(_key(bucket, "")), None if gone else message.data


def _stream(bucket: str) -> str:
    return f"KV_{bucket}"


def _key(bucket: str, key: str) -> str:
    return f"$KV.{bucket}.{key}"
