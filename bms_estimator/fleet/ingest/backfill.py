"""Backfill: the history of packs from Parquet files, in order of time, sent as fast as the workers process it."""

import asyncio
import itertools
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb
import pyarrow as pa
import structlog

from bms_estimator.fleet.ingest.arrow_batch import columns_of
from bms_estimator.fleet.ingest.batch_samples import BatchError, BatchReader, BatchSamples
from bms_estimator.fleet.ingest.ingest_store import IngestStore
from bms_estimator.fleet.ingest.startup import Options, open_ingest
from bms_estimator.fleet.nats.connection import RETRY_S, RETRYABLE_ERRORS, error_text
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import until_first_ends
from bms_estimator.sources.captures.tables.layout import Column

PACK_COLUMN = "pack"
"""Column with the name of the pack. A file without this column has the samples of one pack, and is named after it."""
BATCH_ROWS = 4096
"""Maximum number of rows in memory. This number of rows with 255 cells each has fewer values than ``batch_samples.MAX_VALUES``."""
MEMORY = "1GB"
"""Memory for sorting; larger data are sorted on disk."""
DAY_S = 86_400.0
"""Duration of a day [s]."""


def parquet_files(paths: Sequence[Path]) -> list[Path]:
    """Return the Parquet files at paths, which are files or folders.

    Raises:
        UserError: A path does not exist, or a folder has no Parquet file.
    """
    files = list[Path]()
    for path in paths:
        found = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
        if not found or not path.exists():
            raise UserError(
                f"--parquet {path}: {'no .parquet file in this folder' if path.exists() else 'does not exist'}"
            )
        files += found
    return files


def read_history(
    files: Sequence[Path], reader: BatchReader, folder: Path
) -> Generator[tuple[str, BatchSamples], None, None]:
    """Yield the samples of all packs day by day, and within a day pack by pack, so that several workers are busy.

    Args:
        files: The Parquet files.
        reader: Converter of columns to samples.
        folder: Folder for sorting on disk.

    Raises:
        UserError: A file cannot be read, or a column is missing or invalid.
    """
    with _database(folder) as database:
        rows = database.read_parquet([str(file) for file in files], union_by_name=True, filename=True)
        has_pack = PACK_COLUMN in rows.columns
        used = reader.used_columns([name for name in rows.columns if name not in (PACK_COLUMN, "filename")])
        pack = f"CAST({PACK_COLUMN} AS VARCHAR)" if has_pack else "parse_filename(filename, true)"
        day = f"floor({_seconds(used[0], rows)} / {DAY_S})"
        columns = ", ".join(_quoted(column.name) for column in used)
        selected = rows.project(f"{pack} AS {PACK_COLUMN}, {day} AS day, {columns}")
        ordered = selected.order(f"day, {PACK_COLUMN}, {_quoted(used[0].name)}")
        for batch in ordered.to_arrow_reader(BATCH_ROWS):
            yield from _split(batch, reader)


def _seconds(time: Column, rows: duckdb.DuckDBPyRelation) -> str:
    """Return the SQL expression of a time in seconds."""
    column_type = str(rows.types[rows.columns.index(time.name)])
    if column_type.startswith("TIMESTAMP"):
        return f"epoch({_quoted(time.name)})"
    if column_type == "VARCHAR":
        return f"epoch(TRY_CAST({_quoted(time.name)} AS TIMESTAMPTZ))"
    return f"{time.unit.factor} * {_quoted(time.name)}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _split(rows: pa.RecordBatch, reader: BatchReader) -> Iterator[tuple[str, BatchSamples]]:
    """Yield the samples of each pack in some rows."""
    packs = rows.column(PACK_COLUMN).to_pylist()
    for pack, group in itertools.groupby(range(len(packs)), packs.__getitem__):
        numbers = list(group)
        columns = columns_of(rows.slice(numbers[0], len(numbers)).drop_columns([PACK_COLUMN, "day"]))
        try:
            yield pack or "", reader.read(columns)
        except BatchError as error:
            raise UserError(f"--parquet: pack {pack}: {error}") from None


@contextmanager
def _database(folder: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open a database in memory that sorts larger data in ``folder``.

    Raises:
        UserError: A file cannot be read.
    """
    with duckdb.connect(config={"memory_limit": MEMORY, "temp_directory": str(folder), "threads": 1}) as database:
        try:
            database.execute("SET TimeZone = 'UTC'")
            yield database
        except duckdb.Error as error:
            raise UserError(f"--parquet: {str(error).splitlines()[0]}") from None
        except BatchError as error:
            raise UserError(f"--parquet: {error}") from None


MAX_PART_SAMPLES = 4096
"""Maximum number of samples that are added at a time. They make at most as many blocks."""
MAX_UNCONFIRMED_OF_PACK = 5000
"""Number of unconfirmed blocks of a pack at which the backfill waits. ``MAX_PART_SAMPLES`` more blocks may follow. The sum is
below ``ingest_store.MAX_PACK_BLOCKS``, so that no block is dropped."""
MAX_UNCONFIRMED = 1_000_000
"""Number of unconfirmed blocks of all packs at which the backfill waits: 0.6 GB of minute blocks at 1 Hz."""
SAVE_SAMPLES = 10_000
"""Number of added samples after which the blocks are written to disk."""
WAIT_S = 0.5
"""Poll interval for confirmations of workers [s]."""
REQUEST_S = 10.0
"""Interval between two requests of a confirmation [s]. Workers confirm blocks after their next checkpoint."""
PROGRESS_S = 10.0
"""Interval between two progress lines [s]."""

log = structlog.get_logger(__name__)


async def backfill(options: Options, paths: list[Path], stop: asyncio.Event) -> str:
    """Send the samples of Parquet files until all are sent or ``stop`` is set. Return a summary.

    Raises:
        UserError: A file or an option cannot be used, or another process uses the folder.
    """
    files = parquet_files(paths)
    reader = BatchReader(options.column_map, options.current_sign)
    async with open_ingest(options, stop) as resources:
        if resources is None:
            return "stopped before the server responded"
        _, store, bucket = resources
        history = read_history(files, reader, options.folder)
        sender = Backfill(store, bucket, stop)
        try:
            await sender.send(history)
        finally:
            history.close()
        return sender.summary


class Backfill:
    """Sender of a history.

    Args:
        store: Store of the blocks.
        bucket: Table of packs.
        stop: Ends the run when set.
    """

    def __init__(self, store: IngestStore, bucket: PackBucket, stop: asyncio.Event) -> None:
        self._store, self._bucket, self._stop = store, bucket, stop
        self._counters, self._unknown = Counter[str](), set[str]()
        self._unsaved = 0
        self._progress_s = time.monotonic() + PROGRESS_S

    @property
    def summary(self) -> str:
        """Numbers of samples as text."""
        counters = self._counters
        unknown = ", ".join(sorted(self._unknown)[:10])
        return (
            f"{'stopped: ' if self._stop.is_set() else ''}{counters['samples']:,} samples sent; "
            f"{counters['old']:,} at or before the last stored time of their pack; "
            f"{counters['implausible']:,} with an implausible time; "
            f"{counters['unknown']:,} of packs that are not in the table of packs{f' ({unknown})' if unknown else ''}"
        )

    async def send(self, history: Iterator[tuple[str, BatchSamples]]) -> None:
        """Send the samples of all packs."""
        while (entry := await asyncio.to_thread(next, history, None)) is not None and not self._stop.is_set():
            pack, batch = entry
            if pack not in self._bucket.packs:
                self._unknown.add(pack)
                self._counters["unknown"] += batch.samples.size
                continue
            if pack not in self._store.blocks:
                await self._add_pack(pack)
            for first in range(0, batch.samples.size, MAX_PART_SAMPLES):
                await self._wait_for_confirmations(pack)
                if self._stop.is_set():
                    break
                part = slice(first, first + MAX_PART_SAMPLES)
                await self._add(pack, BatchSamples(batch.samples[part], batch.cells_v[part]))
        self._store.complete()
        await self._save()
        if self._stop.is_set():
            await self._store.send_remaining()
        else:
            await until_first_ends(self._store.wait_until_sent(), self._stop.wait())

    async def _add_pack(self, pack: str) -> None:
        while not self._stop.is_set():
            try:
                await self._store.add_pack(pack)
            except RETRYABLE_ERRORS as error:
                log.warning("the server does not respond; trying again", reason=error_text(error))
                await asyncio.sleep(RETRY_S)
            else:
                return

    async def _add(self, pack: str, batch: BatchSamples) -> None:
        # a value with which ``save`` leaves the progress in ``TELEMETRY`` unchanged
        sequence = self._store.blocks.progress.sequence + 1
        selection = self._store.add(pack, batch, time.time(), sequence)
        self._counters["samples"] += selection.samples.size
        self._counters["old"] += selection.old
        self._counters["implausible"] += selection.implausible
        self._unsaved += selection.samples.size
        if self._unsaved >= SAVE_SAMPLES:
            await self._save()

    async def _save(self) -> None:
        self._unsaved = 0
        await self._store.save(*self._store.blocks.progress)
        if time.monotonic() >= self._progress_s:
            self._progress_s = time.monotonic() + PROGRESS_S
            log.info("backfill", **self._counters, unconfirmed=self._store.blocks.unconfirmed)

    async def _wait_for_confirmations(self, pack: str) -> None:
        """Wait until workers have confirmed enough blocks for further samples."""
        request_s = time.monotonic() + REQUEST_S
        blocks = self._store.blocks
        while not self._stop.is_set() and (
            blocks.unconfirmed_of(pack) >= MAX_UNCONFIRMED_OF_PACK or blocks.unconfirmed >= MAX_UNCONFIRMED
        ):
            await self._save()
            if time.monotonic() >= request_s:
                request_s = time.monotonic() + REQUEST_S
                for each in blocks.packs:
                    self._store.request_confirmation(each)
            await asyncio.sleep(WAIT_S)
