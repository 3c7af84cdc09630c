"""Process that receives batches of telemetry and acts as the edge of their packs."""

import asyncio
import contextlib
import fcntl
import os
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path

import nats.errors
import nats.js.errors
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg

from bms_estimator.edge import subjects
from bms_estimator.fleet.ingest.batch_columns import BatchError
from bms_estimator.fleet.ingest.batch_decoder import decode_batch
from bms_estimator.fleet.ingest.batch_reports import BatchReport, BatchReports
from bms_estimator.fleet.ingest.batch_samples import BatchReader
from bms_estimator.fleet.ingest.ingest_store import IngestStore
from bms_estimator.fleet.ingest.telemetry_reader import TelemetryReader
from bms_estimator.fleet.nats.connection import close, connect, error_text
from bms_estimator.fleet.nats.stream_reader import StoredMessage, StreamError
from bms_estimator.fleet.nats.streams import NoAnswerError, make_telemetry_stream, partitions_of
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.packs.pack_registry import UNKNOWN_PACK
from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import CurrentSign
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.process.tasks import end, until_first_ends
from bms_estimator.sources.captures.tables.layout import ColumnMap

POLL_S = 0.2
"""Poll interval of the stream ``TELEMETRY`` [s]."""
CHECK_S = 2.0
"""Interval between two checks of the stream, of the table of packs, and for overdue blocks [s]."""
STATUS_S = 60.0
"""Interval between two log lines with the counters [s]."""
RETRY_S = 1.0
"""Retry interval after an error of the server [s]."""
PRESENCE_TIMEOUT_S = 1.0
"""Timeout of the request to another process [s]. The server rejects the request at once if no process runs."""
YIELD_MESSAGES = 50
"""Number of messages after which other tasks run."""
RETRYABLE_ERRORS = (nats.errors.Error, nats.js.errors.Error, StreamError, NoAnswerError, TimeoutError)
NAME = "ingest"
"""Name of the process, for systemd and the server."""

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


async def ingest(options: Options, stop: asyncio.Event) -> None:
    """Receive batches until ``stop`` is set; then complete and send the open blocks.

    Raises:
        UserError: An option cannot be used, or another process uses the folder.
    """
    async with opened(options, stop) as started:
        if started is not None:
            nc, store, bucket = started
            reader = BatchReader(options.column_map, options.current_sign)
            await Ingest(nc, store, bucket, reader, SystemdNotifier([NAME], activity="running")).run(stop)


@contextlib.asynccontextmanager
async def opened(options: Options, stop: asyncio.Event) -> AsyncIterator[tuple[Client, IngestStore, PackBucket] | None]:
    """Open connection, store and table of packs; None if ``stop`` is set before the server responds.

    Raises:
        UserError: An option cannot be used, or another process uses the folder.
    """
    with only_ingest(options.folder):
        starting = asyncio.ensure_future(_start(options))
        await until_first_ends(asyncio.wait([starting]), stop.wait())
        if not starting.done():
            await end(starting)
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
                raise UserError(f"the server {options.servers} has closed the connection: check --creds") from None
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


@contextlib.contextmanager
def only_ingest(folder: Path) -> Iterator[None]:
    """Lock the folder against other processes.

    Raises:
        UserError: Another process uses the folder, or the folder cannot be written.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UserError(f"--folder {folder}: cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise UserError(
            f"--folder {folder}: another `fleet ingest` uses it; end it, or choose another folder"
        ) from None
    finally:
        os.close(descriptor)


class Ingest:
    """Loop from the stream ``TELEMETRY`` to the store.

    Args:
        nc: Connection to the tenant's NATS account.
        store: Store of the blocks.
        bucket: Table of packs.
        reader: Converter of batches to samples.
        notifier: Notifies systemd.
    """

    def __init__(
        self, nc: Client, store: IngestStore, bucket: PackBucket, reader: BatchReader, notifier: SystemdNotifier
    ) -> None:
        self._nc, self._store, self._bucket, self._reader, self._notifier = nc, store, bucket, reader, notifier
        self._telemetry = TelemetryReader(nc, store.progress.stream, store.progress.sequence)
        self._reports = BatchReports(nc)
        self._counters = self._reports.counters
        self._trouble = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Receive until ``stop`` is set; then complete the open blocks, and store and send them."""
        loop = asyncio.get_running_loop()
        check_s = status_s = 0.0
        while not stop.is_set():
            self._notifier.alive(NAME)
            if loop.time() >= status_s:
                status_s = loop.time() + STATUS_S
                self._log_status()
            is_check_due = loop.time() >= check_s
            check_s = loop.time() + CHECK_S if is_check_due else check_s
            pause_s = await self._step(check=is_check_due)
            if pause_s:
                await until_first_ends(asyncio.sleep(pause_s), stop.wait())
        self._notifier.stopping(NAME)
        self._store.cut()
        await self._save()
        await self._store.send_remaining()
        self._log_status()

    async def _step(self, *, check: bool) -> float:
        """Process some batches. Return the time until the next step [s].

        Raises:
            UserError: The server has closed the connection permanently.
        """
        try:
            if check:
                await self._check()
            messages = await self._telemetry.read()
            if messages:
                await self._process(messages)
                self._telemetry.sequence = messages[-1].sequence
                await self._save()
        except RETRYABLE_ERRORS as error:
            if self._nc.is_closed:
                raise UserError("the server has closed the connection: check --creds") from None
            if (reason := error_text(error)) != self._trouble:
                log.warning("batches cannot be received; trying again", reason=reason)
            self._trouble = reason
            return RETRY_S
        self._trouble = ""
        return 0.0 if messages else POLL_S

    async def _check(self) -> None:
        """Do the work that is due every ``CHECK_S``."""
        await self._bucket.refresh()
        # an empty table is that of a new server, and removes nothing
        for pack in self._store.packs if len(self._bucket.packs) else ():
            if pack not in self._bucket.packs:
                log.info("a pack was removed from the table; its stored blocks are removed", pack=pack)
                self._store.remove(pack)
        self._store.cut_overdue()
        await self._save()
        await self._telemetry.check(self._store.progress.sequence)
        if self._telemetry.warning:
            log.warning("batches arrive faster than they are stored", reason=self._telemetry.warning)
        self._notifier.ready(NAME)

    async def _save(self) -> None:
        await self._store.save(self._telemetry.stream, self._telemetry.sequence)

    async def _process(self, messages: list[StoredMessage]) -> None:
        """Add the samples of batches to the store."""
        packs = {message.subject.partition(".")[2] for message in messages}
        if any(pack not in self._bucket.packs for pack in packs):
            await self._bucket.refresh()  # the pack may be new
        for pack in packs:
            if pack in self._bucket.packs and pack not in self._store:
                await self._store.add_pack(pack)
        for i, message in enumerate(messages):
            await self._process_one(message)
            if i % YIELD_MESSAGES == 0:
                await asyncio.sleep(0)

    async def _process_one(self, message: StoredMessage) -> None:
        pack = message.subject.partition(".")[2]
        self._counters["batches"] += 1
        if pack not in self._store:
            await self._reports.reject(message, pack, UNKNOWN_PACK, is_dead=False)
            return
        try:
            batch = self._reader.read(decode_batch(message.data))
        except BatchError as error:
            await self._reports.reject(message, pack, str(error))
            return
        last_s = self._store.last_s(pack)
        selection = self._store.add(pack, batch, float(message.received_s), message.sequence)
        self._counters["samples"] += selection.samples.size
        self._counters["old_samples"] += selection.old
        self._counters["implausible_times"] += selection.implausible
        if reason := selection.reason(last_s):
            stored, dropped = selection.samples.size, selection.old + selection.implausible
            await self._reports.report(
                BatchReport(pack=pack, sequence=message.sequence, stored=stored, dropped=dropped, error=reason)
            )

    def _log_status(self) -> None:
        publisher = self._store.publisher
        log.info(
            "ingested",
            **self._counters,
            blocks_sent=publisher.published,
            resends=publisher.resends,
            unconfirmed=self._store.unconfirmed,
            dropped_blocks=self._store.dropped,
        )
