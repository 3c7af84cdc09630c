"""SQLite file of a pack, accessed in a separate thread, so that a slow or failed disk does not block the event loop."""

import asyncio
import contextlib
import math
import os
import sqlite3
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import structlog

from bms_estimator.process.stderr_writer import DaemonThreadExecutor
from bms_estimator.store.migrations import MIGRATIONS, NewerVersionError, OtherTablesError, migrate

DISK_TIMEOUT_S = 10.0
"""Timeout after which the disk counts as hung [s]."""
SHUTDOWN_TIMEOUT_S = 5.0
"""Timeout of all writes during shutdown [s]."""
RETRY_S = 10.0
"""Minimum delay before a failed disk is retried [s]."""
SYNC_S = 30.0
"""Minimum interval between two fsyncs [s]. Commits in between are only handed to the OS. A power failure loses
everything since the last fsync, which happens only with a commit."""
LOCK_TIMEOUT_S = 5.0
"""Timeout of a lock that another process holds on the file [s]."""
LOG_BYTES = 4 << 20
"""Maximum size of the write-ahead log [bytes]."""
FREE_PAGES = 1024
"""Number of free pages of 4 KiB that may always stay in the file for later rows."""
TRIMMED_PAGES = 4096
"""Maximum number of pages moved to shrink the file after one transaction."""
UNUSABLE_CODES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_FORMAT)
"""SQLite error codes of a damaged file."""
UNUSABLE_CODES_AT_OPEN = (*UNUSABLE_CODES, sqlite3.SQLITE_ERROR)
"""SQLite error codes of an unusable file while its tables are checked and created. SQLITE_ERROR then means that the
tables have another schema."""

Result = TypeVar("Result")

log = structlog.get_logger(__name__)


class StoreError(Exception):
    """The database is unavailable; the text gives the reason."""


class Database:
    """Database that runs one transaction at a time. It replaces an unusable file by a new one.

    The caller repeats the work of a failed transaction in a later transaction.

    Args:
        path: Database file, created if missing.
        tables: Statements that create the tables, in the format of ``MIGRATIONS``.
        sync_s: Minimum interval between two fsyncs [s].
        disk_timeout_s: Timeout of a transaction [s].
        retry_s: Delay after a failure before the disk is retried [s].

    Attributes:
        failure_reason: Reason why the database is unavailable; empty while it is available.
    """

    def __init__(
        self,
        path: Path,
        *,
        tables: tuple[str, ...] = MIGRATIONS,
        sync_s: float = SYNC_S,
        disk_timeout_s: float = DISK_TIMEOUT_S,
        retry_s: float = RETRY_S,
    ) -> None:
        self.path, self.failure_reason = path, ""
        self._disk_timeout_s, self._retry_s = disk_timeout_s, retry_s
        self._thread = DaemonThreadExecutor("database")
        self._hung_call: asyncio.Future[Any] | None = None
        self._last_failure_s = -retry_s
        self._shutdown_end_s = math.inf
        self._open_timeouts: set[asyncio.Timeout] = set()
        self._file = _File(path, tables, sync_s)

    async def __aenter__(self) -> Self:
        """Return the database; the first transaction opens the file."""
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Close the file, unless the disk hangs."""
        self.begin_shutdown()
        await self._wait(asyncio.wrap_future(self._thread.submit(self._file.close)))

    def begin_shutdown(self) -> None:
        """Begin the shutdown: all pending and further transactions together may take ``SHUTDOWN_TIMEOUT_S``."""
        self._shutdown_end_s = min(self._shutdown_end_s, asyncio.get_running_loop().time() + SHUTDOWN_TIMEOUT_S)
        for timeout in self._open_timeouts:
            if not timeout.expired():
                timeout.reschedule(min(timeout.when() or self._shutdown_end_s, self._shutdown_end_s))

    async def _wait(self, waiter: asyncio.Future[Any]) -> bool:
        """Return True if the disk responded in time."""
        due_s = min(asyncio.get_running_loop().time() + self._disk_timeout_s, self._shutdown_end_s)
        try:
            async with asyncio.timeout_at(due_s) as timeout:
                self._open_timeouts.add(timeout)
                await asyncio.wait([waiter])
        except TimeoutError:
            return waiter.done()
        finally:
            self._open_timeouts.discard(timeout)
        return True

    @property
    def open_count(self) -> int:
        """Number of times that the file was opened. After a change of this number, rows may be missing."""
        return self._file.open_count

    async def call(self, work: Callable[[sqlite3.Connection], Result]) -> Result:
        """Run ``work`` in a transaction.

        Raises:
            StoreError: The transaction was not committed, or its result is unknown.
        """
        now_s = asyncio.get_running_loop().time()
        if (self._hung_call and not self._hung_call.done()) or now_s - self._last_failure_s < self._retry_s:
            raise StoreError(self.failure_reason)
        running = self._thread.submit(self._file.run, work)
        waiter = asyncio.wrap_future(running)
        began_s = asyncio.get_running_loop().time()
        if not await self._wait(waiter):
            # reading a late exception prevents asyncio from logging it as never retrieved
            waiter.add_done_callback(lambda late: late.cancelled() or late.exception())
            if not running.cancel():
                self._hung_call = waiter
            waited_s = asyncio.get_running_loop().time() - began_s
            raise self._failure(f"the disk has not answered for {waited_s:.2g} s")
        try:
            result = waiter.result()
        except (sqlite3.Error, OSError) as error:
            self._last_failure_s = asyncio.get_running_loop().time()
            raise self._failure(str(error)) from error
        if self.failure_reason:
            log.info("database is back", file=str(self.path))
            self.failure_reason = ""
        return result

    def _failure(self, reason: str) -> StoreError:
        if not self.failure_reason:
            log.warning("database cannot be used: going on in memory", file=str(self.path), reason=reason)
        self.failure_reason = reason
        return StoreError(reason)


class _File:
    """SQLite connection and its file. All methods run in the database thread."""

    def __init__(self, path: Path, tables: tuple[str, ...], sync_s: float) -> None:
        self._path, self._tables, self._sync_s = path, tables, sync_s
        self._connection: sqlite3.Connection | None = None
        self._inode = (0, 0)
        self._ready = False  # the schema was checked
        self._synced_s = -math.inf
        self.open_count = 0

    def run(self, work: Callable[[sqlite3.Connection], Result]) -> Result:
        """Run one transaction, in a new file if the existing one is unusable."""
        try:
            return self._run_once(work)
        except (NewerVersionError, OtherTablesError) as error:
            self._quarantine(str(error))
        except UnicodeDecodeError as error:  # SQLite's error messages quote names of damaged tables
            if self._ready:
                raise
            self._quarantine(str(error))
        except sqlite3.DatabaseError as error:
            code = getattr(error, "sqlite_errorcode", 0)
            # READONLY without an extended code comes from the file's header, because the file was just opened for writing
            # the lowest byte of an extended code is the primary code
            unusable = code == sqlite3.SQLITE_READONLY or code & 0xFF in (
                UNUSABLE_CODES if self._ready else UNUSABLE_CODES_AT_OPEN
            )
            if not unusable:
                raise
            self._quarantine(str(error))
        return self._run_once(work)

    def _run_once(self, work: Callable[[sqlite3.Connection], Result]) -> Result:
        """Run one transaction; open the file if necessary, and close it after an error."""
        try:
            connection = self._open()
            due = time.monotonic() - self._synced_s >= self._sync_s
            connection.execute(f"PRAGMA synchronous = {'FULL' if due else 'NORMAL'}")
            connection.execute("BEGIN IMMEDIATE")
            result = work(connection)
            connection.execute("COMMIT")
        except BaseException:
            self.close()
            raise
        if due:
            self._synced_s = time.monotonic()
        with contextlib.suppress(sqlite3.Error):  # the rows are written; the next transaction reports a disk error
            _trim(connection)
        return result

    def close(self) -> None:
        """Close the file and roll back uncommitted changes."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _open(self) -> sqlite3.Connection:
        """Return a connection to the file at the path.

        The file is reopened if another file replaced it, because rows written to the former file would be lost.
        """
        if self._connection is not None and _inode(self._path) == self._inode:
            return self._connection
        self.close()
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        for suffix in ("", "-wal", "-shm"):
            self._quarantine_non_regular(self._path.with_name(self._path.name + suffix))
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            os.fchmod(descriptor, 0o600)  # SQLite creates its log with the permissions of the database
        finally:
            os.close(descriptor)
        self._inode, self._ready = _inode(self._path), False
        self._connection = sqlite3.connect(self._path, timeout=LOCK_TIMEOUT_S, isolation_level=None)
        self._connection.text_factory = lambda raw: raw.decode(errors="surrogateescape")  # a damaged row must not fail
        self._prepare(self._connection)
        self._ready = True
        self.open_count += 1
        return self._connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # effective only in a new file
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA journal_size_limit = {LOG_BYTES}")
        migrate(connection, self._tables)

    def _quarantine_non_regular(self, path: Path) -> None:
        """Rename a symlink or any other non-regular file, because SQLite would write to its target."""
        try:
            status = path.lstat()
        except FileNotFoundError:
            return
        if not stat.S_ISREG(status.st_mode):
            path.replace(path.with_name(f"{path.name}.refused"))
            log.warning("database path is not a regular file; renamed to *.refused", file=str(path))

    def _quarantine(self, reason: str) -> None:
        """Rename an unusable file and its log."""
        renamed = self._path.with_name(f"{self._path.stem}.refused{self._path.suffix}")
        for suffix in ("", "-wal", "-shm"):
            source, target = (path.with_name(path.name + suffix) for path in (self._path, renamed))
            target.unlink(missing_ok=True)
            if source.exists():
                source.replace(target)
        log.warning("database set aside, a new one is begun", file=str(self._path), reason=reason, aside=renamed.name)


def _trim(connection: sqlite3.Connection) -> None:
    """Release the free pages if they exceed half of the file. With this limit, a page is moved at most once or twice."""
    (free,) = connection.execute("PRAGMA freelist_count").fetchone()
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    if free > max(FREE_PAGES, pages // 2):
        connection.executescript(f"PRAGMA incremental_vacuum({TRIMMED_PAGES})")  # execute() stops after the first page


def _inode(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_dev, status.st_ino
