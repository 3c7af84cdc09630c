"""Start of ``fleet ingest``: lock of the folder, connection, streams, and the check that no other process runs."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import nats.errors
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.folder_lock import lock_folder
from bms_estimator.fleet.ingest.ingest_store import IngestStore
from bms_estimator.fleet.nats.connection import close, connect, retry_until_ready
from bms_estimator.fleet.nats.streams import make_telemetry_stream, require_partitions
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import result_before
from bms_estimator.sources.captures.tables.layout import ColumnMap

NAME = "ingest"
"""Name of the process, for systemd and the server."""
PRESENCE_TIMEOUT_S = 1.0
"""Timeout of the request to another process [s]. The server rejects the request at once if no process runs."""


@dataclass(frozen=True)
class Options:
    """Options of the process.

    Attributes:
        servers, creds, ca: Arguments of ``connect``.
        folder: Folder of the stored blocks.
        block_s: Duration of a block [s].
        buffer_bytes: Maximum size of the stream ``TELEMETRY`` [bytes].
        column_map, current_sign: Arguments of ``BatchReader``.
    """

    servers: str
    folder: Path
    block_s: float
    buffer_bytes: int
    creds: Path | None = None
    ca: Path | None = None
    column_map: ColumnMap | None = None
    current_sign: CurrentSign | None = None


@contextlib.asynccontextmanager
async def open_ingest(
    options: Options, stop: asyncio.Event
) -> AsyncIterator[tuple[Client, IngestStore, PackBucket] | None]:
    """Open connection, store and table of packs; None if ``stop`` is set before the server responds.

    Raises:
        UserError: An option cannot be used, or another process uses the folder.
    """
    with lock_folder(options.folder, ".lock", "another `fleet ingest` uses it; end it", mode=0o700):
        started = await result_before(stop, _start(options))
        if started is None:
            yield None
            return
        nc, partitions, bucket = started
        try:
            async with IngestStore(nc, options.folder, partitions, options.block_s) as store:
                yield nc, store, bucket
        finally:
            await close(nc)


async def _start(options: Options) -> tuple[Client, int, PackBucket]:
    """Connect, and create the stream; repeat until the server has the streams, and no other process runs."""
    nc = await connect(options.servers, NAME, creds=options.creds, ca=options.ca)

    async def prepare() -> tuple[int, PackBucket]:
        await make_telemetry_stream(nc, options.buffer_bytes)
        partitions, bucket = await require_partitions(nc), PackBucket(nc)
        await bucket.refresh()
        return partitions, bucket

    await retry_until_ready(nc, options.servers, lambda: _claim(nc), "waiting")
    return (nc, *await retry_until_ready(nc, options.servers, prepare, "waiting"))


async def _claim(nc: Client) -> None:
    """Check that no other process runs for the tenant, and announce this one.

    Raises:
        UserError: Another process runs.
        nats.errors.Error: The request cannot be sent.
    """
    with contextlib.suppress(nats.errors.NoRespondersError):
        with contextlib.suppress(nats.errors.TimeoutError):
            await nc.request(subjects.INGEST_PRESENCE, timeout=PRESENCE_TIMEOUT_S)
        raise UserError("another `fleet ingest` runs for this tenant: this one starts when it has ended")
    await nc.subscribe(subjects.INGEST_PRESENCE, cb=_ignore)


async def _ignore(_: Msg) -> None:
    """Ignore a request of another process, which needs no reply."""
