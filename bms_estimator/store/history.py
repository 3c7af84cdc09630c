"""History of a pack: one-minute rows and events, for the configured number of days.

Four minutes are written in one transaction, and an event at once or ``WRITE_S`` after the previous transaction, outside the
event loop. ``kill -9`` loses the open minute and what is not written yet.
"""

import asyncio
import contextlib
import secrets
import sqlite3
from collections import deque
from typing import Self, TypeVar

from bms_estimator.model.events import Event, events
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.store.database import Database, StoreError
from bms_estimator.store.minute import MINUTE_S, Minute, MinuteAccumulator, epoch_s, measured_time, minute_start

WRITE_S = 60.0
"""Minimum interval between two writes [s], so that a flapping alarm does not wear the disk. Each write is synced to
disk, because ``WRITE_S`` is longer than the interval between the database's fsyncs."""
WRITTEN_ROWS = 4
"""Number of rows in a transaction, because each transaction writes about nine disk blocks, whatever its number of rows."""
MINUTES_A_DAY = 1440
"""Number of minutes in a day."""
WAITING_MINUTES = 2 * MINUTES_A_DAY
"""Maximum number of rows in memory while the disk cannot be written."""
WAITING_EVENTS = 1000
"""Maximum number of events in memory while the disk cannot be written."""
MAX_EVENTS = 50_000
"""Maximum number of events in the database, so that a flapping line does not fill the disk."""

Row = TypeVar("Row")

_COLUMNS = Minute._fields
_MEAN_COLUMNS = ("voltage_v", "current_a", "temperature_c")
_LAST_VALUE_COLUMNS = ("soc", "soc_std")


def _merge_expression(column: str) -> str:
    """Return SQL that merges a column of two rows of one minute, which exist after a restart within the minute."""
    old, new = f"minute.{column}", f"excluded.{column}"
    if column in _LAST_VALUE_COLUMNS:
        return f"{column} = coalesce({new}, {old})"
    if column in _MEAN_COLUMNS:
        weighted = f"({old} * minute.publications + {new} * excluded.publications)"
        return f"{column} = coalesce({weighted} / (minute.publications + excluded.publications), {new}, {old})"
    if "_min_" in column or "_max_" in column:
        extreme = "min" if "_min_" in column else "max"
        return f"{column} = coalesce({extreme}({old}, {new}), {new}, {old})"
    return f"{column} = {old} + {new}"


_INSERT = (
    f"INSERT INTO minute ({', '.join(_COLUMNS)}) VALUES ({', '.join('?' * len(_COLUMNS))}) "  # noqa: S608 - only constant names
    f"ON CONFLICT (time_s) DO UPDATE SET {', '.join(map(_merge_expression, _COLUMNS[1:]))}"
)


class HistorySink:
    """Sink that stores one-minute rows and events.

    Args:
        database: Database of the history.
        days: Number of days of stored one-minute rows.
    """

    def __init__(self, database: Database, *, days: int) -> None:
        self._database, self._max_rows = database, days * MINUTES_A_DAY
        self._last_snapshot: Snapshot | None = None
        self._last_estimate: Estimate | None = None
        self._last_interval_s = 0.0  # between the last two estimates
        self._open: MinuteAccumulator | None = None
        # waiting rows and events with their numbers
        self._minutes: deque[tuple[int, Minute]] = deque(maxlen=WAITING_MINUTES)
        self._events: deque[tuple[int, Event]] = deque(maxlen=WAITING_EVENTS)
        self._run_id, self._last_number = secrets.token_hex(8), 0
        self._due = asyncio.Event()
        self._closing = asyncio.Event()
        # number of rows written since old rows were last removed; this value makes the first write remove them
        self._rows_since_prune = MINUTES_A_DAY
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Start the writing task."""
        self._task = asyncio.create_task(self._write_repeatedly(), name="history")
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Write the waiting rows and the open minute."""
        if self._task is None:
            return
        self._close_minute()
        self._closing.set()
        self._database.begin_shutdown()
        self._due.set()
        await self._task

    def publish(self, snapshot: Snapshot) -> None:
        """Record a snapshot without waiting for the disk."""
        if self._task is not None and self._task.done():
            self._task.result()  # only an internal error ends the task: raise it
        if new_events := events(self._last_snapshot, snapshot):
            self._events.extend((self._next_number(), event) for event in new_events)
            self._due.set()
        self._last_snapshot = snapshot
        if snapshot.estimate is not None:
            self._add(snapshot.estimate)

    def _add(self, estimate: Estimate) -> None:
        time_s = minute_start(epoch_s(estimate.time))
        if self._open is None or self._open.time_s != time_s:
            self._close_minute()
            self._open = MinuteAccumulator(time_s)
        interval_s = estimate.board_time_s - self._last_estimate.board_time_s if self._last_estimate else 0.0
        self._open.add(estimate, measured_time(interval_s, self._last_interval_s))
        self._last_estimate, self._last_interval_s = estimate, interval_s

    def _close_minute(self) -> None:
        row = self._open.row() if self._open else None
        self._open = None
        if row is not None:
            self._minutes.append((self._next_number(), row))
            if len(self._minutes) >= WRITTEN_ROWS:
                self._due.set()

    def _next_number(self) -> int:
        self._last_number += 1
        return self._last_number

    async def _write_repeatedly(self) -> None:
        """Write minutes and events. After a failure, retry with the next ones, or after ``WRITTEN_ROWS`` minutes."""
        while not self._closing.is_set():
            with contextlib.suppress(TimeoutError):  # without samples no minute ends, but a failed write is retried
                async with asyncio.timeout(WRITTEN_ROWS * MINUTE_S):
                    await self._due.wait()
            self._due.clear()
            if not self._closing.is_set():
                await self._write()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(WRITE_S):
                        await self._closing.wait()
        await self._write()

    async def _write(self) -> None:
        """Write the waiting rows. Skip rows that an earlier transaction with unknown result has written."""
        minutes, waiting_events, last_number = list(self._minutes), list(self._events), self._last_number
        if not minutes and not waiting_events:
            return
        prune = self._rows_since_prune + len(minutes) > MINUTES_A_DAY

        def write(connection: sqlite3.Connection) -> None:
            query = "SELECT max(number) FROM history_mark WHERE run = ?"
            (marked,) = connection.execute(query, (self._run_id,)).fetchone()
            written = marked or 0
            for number, row in minutes:
                if number > written:
                    connection.execute(_INSERT, row._replace(time_s=_row_time(connection, row)))
            rows = [
                (epoch_s(event.time), event.name, event.text) for number, event in waiting_events if number > written
            ]
            connection.executemany("INSERT INTO event (time_s, name, text) VALUES (?, ?, ?)", rows)
            connection.execute("DELETE FROM history_mark")
            connection.execute("INSERT INTO history_mark VALUES (?, ?)", (self._run_id, last_number))
            if prune:
                _prune(connection, self._max_rows)

        try:
            await self._database.call(write)
        except StoreError:
            return
        _remove(self._minutes, last_number)
        _remove(self._events, last_number)
        self._rows_since_prune = 0 if prune else self._rows_since_prune + len(minutes)


def _row_time(connection: sqlite3.Connection, row: Minute) -> int:
    """Return the timestamp of a row: the start of its minute, or some seconds later if the clock was set back.

    If two rows of a minute contain more than 60 s of measured time together, the clock was set back between them.
    """
    for time_s in range(row.time_s, row.time_s + MINUTE_S):
        existing = connection.execute("SELECT seen_s FROM minute WHERE time_s = ?", (time_s,)).fetchone()
        if existing is None or existing[0] + row.seen_s <= MINUTE_S:
            break
    return time_s


def _remove(waiting: deque[tuple[int, Row]], last_number: int) -> None:
    """Remove the written items up to number ``last_number``."""
    while waiting and waiting[0][0] <= last_number:
        waiting.popleft()


def _prune(connection: sqlite3.Connection, max_rows: int) -> None:
    """Delete all but the newest ``max_rows`` rows.

    The limit is a number and not an age, because a clock that jumps ahead would make all rows too old.
    """
    oldest = connection.execute(
        "SELECT time_s FROM minute ORDER BY time_s DESC LIMIT 1 OFFSET ?", (max_rows - 1,)
    ).fetchone()
    if oldest is not None:
        connection.execute("DELETE FROM minute WHERE time_s < ?", oldest)
        connection.execute("DELETE FROM event WHERE time_s < ?", oldest)
    newest_excess = "SELECT number FROM event ORDER BY number DESC LIMIT 1 OFFSET ?"
    connection.execute(f"DELETE FROM event WHERE number <= ({newest_excess})", (MAX_EVENTS,))  # noqa: S608
