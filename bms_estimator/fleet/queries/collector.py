"""Collector that writes the stream ``HOURS`` to Parquet files.

A row is acknowledged as soon as its file is on disk. The server redelivers it until then.
"""

import asyncio
import contextlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import duckdb
import nats.errors
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig
from nats.js.errors import NotFoundError
from pydantic import ValidationError

from bms_estimator.edge.subjects import HOURS_STREAM, PACKS_BUCKET
from bms_estimator.fleet.folder_lock import lock_folder
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.nats.bucket_reader import BucketReader
from bms_estimator.fleet.nats.stream_reader import StreamError
from bms_estimator.fleet.queries.parquet_files import (
    QUARANTINE_FOLDER,
    compact,
    days_to_compact,
    read_packs,
    remove_unfinished,
    write,
    write_packs,
)
from bms_estimator.model.clock import Clock
from bms_estimator.model.errors import TemporaryError, UserError

DURABLE = "collector"
"""Name of the durable consumer, with which a collector continues where the previous one ended."""
PERIOD_S = 300.0
"""Maximum time that a row waits for its file [s]. A shorter time gives more files a day, which slow down queries."""
MAX_ROWS = 10_000
"""Maximum number of rows of a file. Until it is written, the rows wait in memory and take 5 kB each."""
FETCH_ROWS = 1000
"""Maximum number of rows in one request."""
FETCH_S = 0.5
"""Timeout of a request when no row is waiting [s]."""
COMPACT_S = 600.0
"""Interval between two merges of the files of a day [s]."""
TABLE_S = 60.0
"""Interval between two reads of the table of packs [s]."""
RETRY_S = 10.0
"""Retry interval after an error of disk or server [s]."""

log = structlog.get_logger(__name__)


class Collector:
    """Collector of hourly rows.

    Args:
        nc: Connection to the tenant's NATS account, which reconnects.
        folder: Folder of the Parquet files.
        period_s: Maximum time that a row waits for its file [s].
        clock: Wall and monotonic clock.

    Attributes:
        counters: Numbers of written ``rows`` and ``files``, of ``unreadable`` messages, and of ``faults`` of server or disk.
    """

    def __init__(self, nc: Client, folder: Path, *, period_s: float = PERIOD_S, clock: Clock | None = None) -> None:
        self._nc, self._folder, self._period_s, self._clock = nc, folder, period_s, clock or Clock()
        self._subscription: JetStreamContext.PullSubscription | None = None
        self._waiting: list[tuple[Msg, Hour]] = []
        self._first_waiting_s = self._clock.monotonic()  # arrival of the oldest waiting row
        self._compacted_s = self._first_waiting_s  # last merge of files
        self._table_read_s = -math.inf
        self._table = BucketReader(nc, PACKS_BUCKET)
        # hour of addition to the table by pack: of packs in the table, and of packs in ``PACKS_FILE``
        self._listed, self._stored_packs = dict[str, int](), read_packs(folder)
        self.counters = Counter[str]()

    async def run(self, stop: asyncio.Event) -> None:
        """Collect until ``stop`` is set; then write the waiting rows.

        Raises:
            UserError: The server has no such stream, or has closed the connection permanently.
        """
        while not stop.is_set():
            await self._queue_rows(await self._fetch(stop))
            now_s = self._clock.monotonic()
            if len(self._waiting) >= MAX_ROWS or (self._waiting and now_s - self._first_waiting_s >= self._period_s):
                await self._save(stop)
            if now_s - self._table_read_s >= TABLE_S:
                self._table_read_s = now_s
                await self._save_table()
            if now_s - self._compacted_s >= COMPACT_S:
                self._compacted_s = now_s
                await asyncio.to_thread(compact_days, self._folder, self._clock.wall())
        if self._waiting:
            await self._save(stop)

    async def _subscribe(self) -> JetStreamContext.PullSubscription:
        js = self._nc.jetstream()
        # longer than a row waits in this process; otherwise the server would redeliver the row
        wait_s = 2.0 * self._period_s + 60.0
        # 3 * MAX_ROWS: rows that wait here, and rows of an ended process that are not yet redelivered
        config = ConsumerConfig(
            durable_name=DURABLE, ack_policy=AckPolicy.EXPLICIT, ack_wait=wait_s, max_ack_pending=3 * MAX_ROWS
        )
        try:
            await js.add_consumer(HOURS_STREAM, config)
            return await js.pull_subscribe_bind(DURABLE, HOURS_STREAM)
        except NotFoundError:
            raise UserError(
                f"the server has no stream {HOURS_STREAM}: `bms-estimator fleet serve` creates it when it starts"
            ) from None

    async def _fetch(self, stop: asyncio.Event) -> Sequence[Msg]:
        """Fetch up to ``FETCH_ROWS`` messages; none without a connection."""
        try:
            self._subscription = self._subscription or await self._subscribe()
            return await self._subscription.fetch(FETCH_ROWS, timeout=FETCH_S)
        except (nats.errors.TimeoutError, TimeoutError):
            return ()
        except nats.errors.Error as error:
            self._subscription = None
            if self._nc.is_closed:
                raise TemporaryError("the server has closed the connection: check --creds") from None
            await self._wait_after_error("rows cannot be fetched from the server", error, stop)
            return ()

    async def _queue_rows(self, messages: Sequence[Msg]) -> None:
        if messages and not self._waiting:
            self._first_waiting_s = self._clock.monotonic()
        for message in messages:
            try:
                row = Hour.model_validate_json(message.data)
            except ValidationError as error:
                await self._reject(message, error)
            else:
                self._waiting.append((message, row))

    async def _reject(self, message: Msg, error: ValidationError) -> None:
        """Log a message that cannot be decoded, and end its delivery. The message stays in the stream."""
        self.counters["unreadable"] += 1
        detail = error.errors()[0]
        reason = f"{'.'.join(map(str, detail['loc'])) or 'message'}: {detail['msg']}"
        log.warning("invalid row of an hour", subject=message.subject, reason=reason)
        with contextlib.suppress(nats.errors.Error):  # the message is then redelivered and rejected again
            await message.term()

    async def _save(self, stop: asyncio.Event) -> None:
        """Write the waiting rows and acknowledge them. If they cannot be written, the server redelivers them."""
        waiting, self._waiting = self._waiting, []
        try:
            files = await asyncio.to_thread(write, self._folder, [row for _, row in waiting])
        except OSError as error:
            await self._wait_after_error("rows cannot be written; the server delivers them again", error, stop)
            return
        self.counters["rows"] += len(waiting)
        self.counters["files"] += len(files)
        try:
            for message, _ in waiting:
                await message.ack()
            await self._nc.flush()
        except (nats.errors.Error, TimeoutError) as error:  # the rows are delivered again; queries drop duplicates
            await self._wait_after_error("written rows could not be acknowledged", error, stop)

    async def _save_table(self) -> None:
        """Read the changes of the table of packs, and write the packs to a file. After an error the next call tries again."""
        now_hour = int(self._clock.wall() // HOUR_S)

        def set_row(pack: str, row: bytes | None) -> None:
            if row is None:
                self._listed.pop(pack, None)
            else:
                self._listed.setdefault(pack, self._stored_packs.get(pack, now_hour))

        try:
            await self._table.read(set_row)
            if self._listed != self._stored_packs:
                await asyncio.to_thread(write_packs, self._folder, self._listed)
                self._stored_packs = dict(self._listed)
        except (StreamError, nats.errors.Error, OSError) as error:
            log.warning("the table of packs cannot be stored", reason=str(error))

    async def _wait_after_error(self, event: str, error: Exception, stop: asyncio.Event) -> None:
        """Count and log an error, and wait before the next attempt."""
        self.counters["faults"] += 1
        log.warning(event, reason=str(error) or type(error).__name__, again_in_s=RETRY_S)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), RETRY_S)


def compact_days(folder: Path, now_s: float) -> None:
    """Merge the files of the days that ``days_to_compact`` returns, also in quarantine. Errors are logged; the next call retries.

    Args:
        folder: Folder of the Parquet files.
        now_s: Wall clock [s since 1970].
    """
    for day in [*days_to_compact(folder, now_s), *days_to_compact(folder / QUARANTINE_FOLDER, now_s)]:
        try:
            compact(day)
        except (OSError, duckdb.Error) as error:
            log.warning("the files of a day cannot be merged", day=str(day), reason=str(error))


@contextlib.contextmanager
def only_collector(folder: Path) -> Iterator[None]:
    """Lock the folder against other collectors, and remove unfinished files of a killed one.

    Raises:
        TemporaryError: Another collector writes there, or the folder cannot be written.
    """
    with lock_folder(folder, ".collector", "another collector writes there; end it"):
        for each in (folder, folder / QUARANTINE_FOLDER):
            remove_unfinished(each)
        yield
