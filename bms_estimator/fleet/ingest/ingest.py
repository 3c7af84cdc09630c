"""Process that receives batches of telemetry in JSON or Arrow IPC, and acts as the edge of their packs."""

import asyncio
import json
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import structlog
from nats.aio.client import Client

from bms_estimator.fleet.ingest.batch_reports import BatchReport, BatchReports
from bms_estimator.fleet.ingest.batch_samples import (
    BatchColumns,
    BatchError,
    BatchReader,
    check_count,
    drop_reason,
    split_by_time,
)
from bms_estimator.fleet.ingest.ingest_store import IngestStore
from bms_estimator.fleet.ingest.startup import NAME, Options, open_ingest
from bms_estimator.fleet.ingest.telemetry_reader import DamagedStreamError, MissingStreamError, TelemetryReader
from bms_estimator.fleet.nats.connection import RETRY_S, RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.nats.stream_reader import StoredMessage
from bms_estimator.fleet.nats.streams import make_telemetry_stream
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.runtime import until_first_ends
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.sources.captures.tables.layout import REQUIRED

_ARROW_STREAM, _ARROW_FILE = b"\xff\xff\xff\xff", b"ARROW1"
"""First bytes of an Arrow IPC stream and of an Arrow IPC file. In a file, a stream follows after 8 bytes."""


def decode_batch(payload: bytes) -> BatchColumns:
    """Return the columns of a batch.

    Args:
        payload: Arrow IPC; a JSON object of columns, each a list; a JSON object that is one row; or a JSON list of rows, each
            an object.

    Raises:
        BatchError: The bytes are none of these, or the columns differ in length.
    """
    if payload.startswith((_ARROW_STREAM, _ARROW_FILE)):
        from bms_estimator.fleet.ingest.arrow_batch import decode_arrow  # noqa: PLC0415 - JSON needs no Arrow

        return decode_arrow(payload[8:] if payload.startswith(_ARROW_FILE) else payload)
    try:
        document = json.loads(payload, object_pairs_hook=_unique_members)
    except BatchError:
        raise
    except (ValueError, RecursionError) as error:
        raise BatchError(f"neither JSON nor Arrow IPC: {error}") from None
    columns = _columns_of_rows(document) if isinstance(document, list) else _columns_of_object(document)
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise BatchError(f"the columns differ in length: {lengths}")
    return columns


def _unique_members(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object.

    Raises:
        BatchError: Several members have the same name.
    """
    document = dict(members)
    if len(document) < len(members):
        raise BatchError("several columns have the same name")
    return document


def _columns_of_object(document: object) -> BatchColumns:
    """Return the columns of an object.

    An object with at least as many lists as a sample has required columns has one list for each column; its other values are
    ignored. Any other object is one row.
    """
    if not isinstance(document, dict) or not document:
        raise BatchError("must be an object of columns or a list of rows")
    lists = {name: values for name, values in document.items() if isinstance(values, list)}
    return lists if len(lists) >= len(REQUIRED) else {name: [value] for name, value in document.items()}


def _columns_of_rows(rows: list[Any]) -> BatchColumns:
    """Return the columns of a list of rows. A row may lack columns of the first row."""
    if not rows:
        raise BatchError("has no rows")
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict):
            raise BatchError(f"row {number} is no object with the names of columns")
    check_count(len(rows) * len(rows[0]))
    return {name: [row.get(name) for row in rows] for name in rows[0]}


POLL_S = 0.2
"""Poll interval of the stream ``TELEMETRY`` [s]."""
CHECK_S = 2.0
"""Interval between two checks of the stream, of the table of packs, and for overdue blocks [s]."""
STATUS_S = 60.0
"""Interval between two log lines with the counters [s]."""
YIELD_MESSAGES = 50
"""Number of messages after which the loop yields to other tasks."""
MAX_PART_SAMPLES = 500
"""Maximum number of samples, and therefore of completed blocks, after which the loop yields to other tasks."""

log = structlog.get_logger(__name__)


async def ingest(options: Options, stop: asyncio.Event) -> None:
    """Receive batches until ``stop`` is set; then complete and send the open blocks.

    Raises:
        UserError: An option cannot be used, or another process uses the folder.
    """
    async with open_ingest(options, stop) as resources:
        if resources is not None:
            nc, store, bucket = resources
            reader = BatchReader(options.column_map, options.current_sign)
            notifier = SystemdNotifier([NAME], activity="running")
            await Ingest(nc, store, bucket, reader, notifier, options.buffer_bytes).run(stop)


class Ingest:
    """Loop from the stream ``TELEMETRY`` to the store.

    Args:
        nc: Connection to the tenant's NATS account.
        store: Store of the blocks.
        bucket: Table of packs.
        reader: Converter of batches to samples.
        notifier: Notifies systemd.
        buffer_bytes: Maximum size of the stream ``TELEMETRY`` [bytes].
    """

    def __init__(
        self,
        nc: Client,
        store: IngestStore,
        bucket: PackBucket,
        reader: BatchReader,
        notifier: SystemdNotifier,
        buffer_bytes: int,
    ) -> None:
        self._nc, self._store, self._bucket, self._reader, self._notifier = nc, store, bucket, reader, notifier
        self._buffer_bytes = buffer_bytes
        self._telemetry = TelemetryReader(nc, *store.blocks.progress)
        self._reports = BatchReports(nc)
        self._counters = self._reports.counters
        self._last_failure = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Receive until ``stop`` is set; then complete the open blocks, and store and send them."""
        loop = asyncio.get_running_loop()
        next_check_s = next_status_s = 0.0
        while not stop.is_set():
            self._notifier.alive(NAME)
            if loop.time() >= next_status_s:
                next_status_s = loop.time() + STATUS_S
                self._log_status()
            is_check_due = loop.time() >= next_check_s
            next_check_s = loop.time() + CHECK_S if is_check_due else next_check_s
            pause_s = await self._step(check=is_check_due)
            if pause_s:
                await until_first_ends(asyncio.sleep(pause_s), stop.wait())
        self._notifier.stopping(NAME)
        await self._save_open_blocks()
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
        except (*RETRYABLE_ERRORS, UserError) as error:
            if self._nc.is_closed:
                raise TemporaryError("the server has closed the connection: check --creds") from None
            if (reason := error_text(error)) != self._last_failure:
                log.warning("batches cannot be received; trying again", reason=reason)
            self._last_failure = reason
            return RETRY_S
        self._last_failure = ""
        return 0.0 if messages else POLL_S

    async def _check(self) -> None:
        """Apply changes of the table, save overdue blocks, check the stream, and report readiness to systemd."""
        await self._bucket.refresh()
        # a new server has an empty table, which must not remove the packs
        for pack in self._store.blocks.packs if len(self._bucket.packs) else ():
            if pack not in self._bucket.packs:
                log.info("a pack was removed from the table; its stored blocks are removed", pack=pack)
                self._store.remove(pack)
        self._store.complete(time.monotonic())  # blocks of packs that send nothing more
        await self._save()
        await self._check_stream()
        if self._telemetry.warning:
            log.warning("batches arrive faster than they are stored", reason=self._telemetry.warning)
        self._notifier.ready(NAME)

    async def _check_stream(self) -> None:
        """Check the stream, and create it again if it is missing or damaged."""
        try:
            lost = await self._telemetry.check(self._store.blocks.progress.sequence)
            if lost is not None:
                await self._on_lost(lost)
        except MissingStreamError:  # the server was replaced
            await make_telemetry_stream(self._nc, self._buffer_bytes)
        except DamagedStreamError as error:
            is_damaged = self._telemetry.is_damaged
            action = "it is deleted and created again" if is_damaged else "trying again"
            log.warning("the server has an error in the stream of batches", action=action, reason=str(error))
            if not is_damaged:
                return
            await self._save_open_blocks()
            await self._telemetry.delete()
            await make_telemetry_stream(self._nc, self._buffer_bytes)

    async def _on_lost(self, lost: range) -> None:
        """Save the open blocks, whose batches the server may have lost, too, and log the lost batches."""
        await self._save_open_blocks()
        if lost:
            self._counters["lost_batches"] += len(lost)
            log.error("the server has lost batches", batches=len(lost), first=lost[0], last=lost[-1])

    async def _save_open_blocks(self) -> None:
        """Complete and save the open blocks, whose batches are not read again."""
        self._store.complete()
        await self._save()

    async def _save(self) -> None:
        await self._store.save(self._telemetry.stream, self._telemetry.sequence)

    async def _process(self, messages: list[StoredMessage]) -> None:
        """Add the samples of batches to the store."""
        packs = {message.subject.partition(".")[2] for message in messages}
        if any(pack not in self._bucket.packs for pack in packs):
            await self._bucket.refresh()  # the pack may be new
        for pack in packs:
            if pack in self._bucket.packs and pack not in self._store.blocks:
                await self._store.add_pack(pack)
        for i, message in enumerate(messages):
            await self._process_one(message)
            if i % YIELD_MESSAGES == 0:
                await asyncio.sleep(0)

    async def _process_one(self, message: StoredMessage) -> None:
        pack = message.subject.partition(".")[2]
        self._counters["batches"] += 1
        if pack not in self._store.blocks:
            await self._reports.reject_unknown(message, pack)
            return
        last_s, counts = self._store.last_s(pack), Counter[str]()
        try:
            await self._add(message, pack, counts)
        except Exception as error:  # noqa: BLE001 - no batch may stop the others
            await self._reports.reject(message, pack, _reason(error), counts["samples"])
        else:
            old, implausible = counts["old_samples"], counts["implausible_times"]
            if reason := drop_reason(old, implausible, last_s):
                stored, dropped = counts["samples"], old + implausible
                await self._reports.report(
                    BatchReport(pack=pack, sequence=message.sequence, stored=stored, dropped=dropped, error=reason)
                )
        self._counters.update(counts)

    async def _add(self, message: StoredMessage, pack: str, counts: Counter[str]) -> None:
        """Add the samples of a batch, and count them. Other tasks run between its parts.

        Raises:
            Exception: The batch is invalid. Earlier parts of it stay stored.
        """
        batch = self._reader.read(decode_batch(message.data))
        for i, part in enumerate(split_by_time(batch, MAX_PART_SAMPLES)):
            if i:
                self._notifier.alive(NAME)
                await asyncio.sleep(0)
            selection = self._store.add(pack, part, float(message.received_s), message.sequence)
            counts["samples"] += selection.samples.size
            counts["old_samples"] += selection.old
            counts["implausible_times"] += selection.implausible

    def _log_status(self) -> None:
        self._reports.log_unknown()
        blocks = self._store.blocks
        log.info(
            "ingested",
            **self._counters,
            blocks_sent=self._store.published,
            resends=blocks.resends,
            unconfirmed=blocks.unconfirmed,
            dropped_blocks=blocks.dropped,
        )


def _reason(error: Exception) -> str:
    """Return the reason of a rejected batch; for an internal error with file and line."""
    if isinstance(error, BatchError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"internal error: {type(error).__name__} in {Path(place.filename).name}, line {place.lineno}: {error}"
