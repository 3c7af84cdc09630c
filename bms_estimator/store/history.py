"""History of a pack: one-minute rows and events, for the configured number of days.

A row has means, extremes and sums of the publications of a minute. A thread writes four rows in one transaction, and an event
at once or ``WRITE_S`` after the previous transaction. ``kill -9`` loses the open minute and unwritten rows and events.
"""

import asyncio
import contextlib
import math
import secrets
import sqlite3
from collections import deque
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple, Self, TypeVar

from bms_estimator.model.events import Event, events
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.store.database import Database, StoreError

MINUTE_S = 60
MAX_INTERVAL_S = 30.0
"""Maximum interval between two publications that is never a gap [s]. No charge is counted over a gap."""
GAP_RATIO = 3.0
"""Maximum ratio of an interval to the previous interval that is not a gap, so that a slow source has no gaps."""


class Minute(NamedTuple):
    """Row of the history; missing values are None. Means and extremes are taken over the published values."""

    time_s: int
    """Start of the minute [s since 1970]."""
    voltage_v: float
    voltage_min_v: float
    voltage_max_v: float
    current_a: float
    """Positive on discharge."""
    current_min_a: float
    current_max_a: float
    temperature_c: float | None
    temperature_min_c: float | None
    temperature_max_c: float | None
    soc: float | None
    """Last published SOC, 0..1."""
    soc_std: float | None
    charge_out_ah: float
    charge_in_ah: float
    energy_out_wh: float
    energy_in_wh: float
    seen_s: float
    """Measured part of the minute [s]."""
    publications: int


@dataclass
class _Statistics:
    """Mean and extremes of one quantity."""

    count: int = 0
    total: float = 0.0
    minimum: float = math.inf
    maximum: float = -math.inf

    def add(self, value: float | None) -> None:
        if value is not None:
            self.count += 1
            self.total += value
            self.minimum, self.maximum = min(self.minimum, value), max(self.maximum, value)

    @property
    def values(self) -> tuple[float, float, float]:
        """Mean, minimum and maximum."""
        return self.total / self.count, self.minimum, self.maximum


@dataclass
class MinuteAccumulator:
    """Accumulator of the open minute, which starts at ``time_s`` [s since 1970]."""

    time_s: int
    _voltage: _Statistics = field(default_factory=_Statistics)
    _current: _Statistics = field(default_factory=_Statistics)
    _temperature: _Statistics = field(default_factory=_Statistics)
    _last: Estimate | None = None
    _charge_as: list[float] = field(default_factory=lambda: [0.0, 0.0])  # out and in [A s]
    _energy_ws: list[float] = field(default_factory=lambda: [0.0, 0.0])  # out and in [W s]
    _seen_s: float = 0.0

    def add(self, estimate: Estimate, seen_s: float) -> None:
        """Add a publication. ``seen_s`` is the measured time since the previous publication [s]; see ``measured_time``."""
        self._voltage.add(estimate.voltage_v)
        self._current.add(estimate.current_a)
        self._temperature.add(estimate.temperature_c)
        self._last = estimate
        self._seen_s += seen_s
        self._charge_as[estimate.current_a < 0.0] += abs(estimate.current_a) * seen_s
        self._energy_ws[estimate.power_w < 0.0] += abs(estimate.power_w) * seen_s

    def row(self) -> Minute | None:
        """Return the row of the minute; None if nothing was published."""
        if self._last is None:
            return None
        charge_out, charge_in = (charge_as / 3600.0 for charge_as in self._charge_as)
        energy_out, energy_in = (energy_ws / 3600.0 for energy_ws in self._energy_ws)
        voltage_and_current = *self._voltage.values, *self._current.values
        temperature = self._temperature.values if self._temperature.count else (None, None, None)
        publications = self._voltage.count
        sums = charge_out, charge_in, energy_out, energy_in, self._seen_s, publications
        return Minute._make(
            (self.time_s, *voltage_and_current, *temperature, self._last.soc, self._last.soc_std, *sums)
        )


def measured_time(interval_s: float, previous_interval_s: float) -> float:
    """Return the time between two publications [s], or 0 if the time is a gap or the clock went back.

    Args:
        interval_s: Time between the two publications on the board's clock [s].
        previous_interval_s: Time between the previous two publications [s].
    """
    return interval_s if 0.0 < interval_s <= max(MAX_INTERVAL_S, GAP_RATIO * previous_interval_s) else 0.0


def epoch_s(time: str) -> float:
    """Convert a published time to seconds since 1970."""
    return datetime.fromisoformat(time).timestamp()


def minute_start(time_s: float) -> int:
    """Return the start of the minute that contains a time [s since 1970]."""
    return int(time_s // MINUTE_S) * MINUTE_S


WRITE_S = 60.0
"""Minimum interval between two writes [s], so that a flapping alarm does not wear the disk. Each write is synced to
disk, because ``WRITE_S`` is longer than the interval between the database's fsyncs."""
WRITTEN_ROWS = 4
"""Number of rows in a transaction. A transaction writes about nine disk blocks, whatever its number of rows."""
MINUTES_A_DAY = 1440
MAX_WAITING_ROWS = 2 * MINUTES_A_DAY
"""Maximum number of rows in memory while the disk cannot be written."""
MAX_WAITING_EVENTS = 1000
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
        self._minutes: deque[tuple[int, Minute]] = deque(maxlen=MAX_WAITING_ROWS)
        self._events: deque[tuple[int, Event]] = deque(maxlen=MAX_WAITING_EVENTS)
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
    newest_to_delete = "SELECT number FROM event ORDER BY number DESC LIMIT 1 OFFSET ?"
    connection.execute(f"DELETE FROM event WHERE number <= ({newest_to_delete})", (MAX_EVENTS,))  # noqa: S608
