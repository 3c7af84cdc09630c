"""Start of ``fleet ingest``: lock of the folder, connection, streams, and the check that no other process runs."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import nats.errors
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.folder_lock import lock_folder
from bms_estimator.fleet.ingest.ingest_store import IngestStore
from bms_estimator.fleet.nats.connection import RETRY_S, RETRYABLE_ERRORS, close, connect, error_text
from bms_estimator.fleet.nats.streams import make_telemetry_stream, partitions_of
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.model.arrays import CurrentSign
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.runtime import end_tasks, until_first_ends
from bms_estimator.sources.captures.tables.layout import ColumnMap

NAME = "ingest"
"""Name of the process, for systemd and the server."""
PRESENCE_TIMEOUT_S = 1.0
"""Timeout of the request to another process [s]. The server rejects the request at once if no process runs."""

log = structlog.get_logger(__name__)


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
        starting = asyncio.ensure_future(_start(options))
        await until_first_ends(asyncio.wait([starting]), stop.wait())
        if not starting.done():
            await end_tasks(starting)
            yield None
            return
        nc, partitions, bucket = starting.result()
        try:
            async with IngestStore(nc, options.folder, partitions, options.block_s) as store:
                yield nc, store, bucket
        finally:
            await close(nc)


async def _start(options: Options) -> tuple[Client, int, PackBucket]:
    """Connect, and create the stream; repeat until the server has the streams, and no other process runs."""
    nc = await connect(options.servers, NAME, creds=options.creds, ca=options.ca)
    last_reason, is_claimed = "", False
    while True:
        try:
            if not is_claimed:
                await _claim(nc)
            is_claimed = True
            await make_telemetry_stream(nc, options.buffer_bytes)
            partitions = await partitions_of(nc)
            bucket = PackBucket(nc)
            await bucket.refresh()
        except (*RETRYABLE_ERRORS, UserError) as error:
            if nc.is_closed:
                raise TemporaryError(f"the server {options.servers} has closed the connection: check --creds") from None
            if (text := error_text(error)) != last_reason:
                log.warning("waiting", reason=text)
            last_reason = text
            await asyncio.sleep(RETRY_S)
            continue
        if partitions is not None:
            return nc, partitions, bucket


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
