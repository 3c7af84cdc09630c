"""Tables of a pack's database, and migrations from older versions."""

import contextlib
import functools
import sqlite3

MIGRATIONS = (
    """
    CREATE TABLE outbox (
        number INTEGER PRIMARY KEY,
        topic TEXT NOT NULL,
        payload BLOB NOT NULL,
        qos INTEGER NOT NULL,
        retain INTEGER NOT NULL
    );
    CREATE TABLE minute (
        time_s INTEGER PRIMARY KEY,
        voltage_v REAL, voltage_min_v REAL, voltage_max_v REAL,
        current_a REAL, current_min_a REAL, current_max_a REAL,
        temperature_c REAL, temperature_min_c REAL, temperature_max_c REAL,
        soc REAL, soc_std REAL,
        charge_out_ah REAL, charge_in_ah REAL, energy_out_wh REAL, energy_in_wh REAL,
        seen_s REAL,
        publications INTEGER NOT NULL
    );
    CREATE TABLE event (
        number INTEGER PRIMARY KEY,
        time_s REAL NOT NULL,
        name TEXT NOT NULL,
        text TEXT NOT NULL
    );
    CREATE INDEX event_time ON event (time_s);
    """,
    "CREATE TABLE history_mark (run TEXT NOT NULL, number INTEGER NOT NULL);",
)
"""Statements that migrate version n to version n + 1. Released statements are never changed.

Table ``history_mark`` has one row: all numbered rows and events up to ``number`` of the process ``run`` are written."""


class NewerVersionError(Exception):
    """The database was written by a later version of the program."""


class OtherTablesError(Exception):
    """The tables differ from those that the migrations create."""


def migrate(connection: sqlite3.Connection, migrations: tuple[str, ...] = MIGRATIONS) -> None:
    """Migrate a database to the latest version. An empty database has version 0.

    Args:
        connection: Connection to the database.
        migrations: Statements of each version, as ``MIGRATIONS``.

    Raises:
        NewerVersionError: The database has a later version.
        OtherTablesError: The tables differ from those that the migrations create.
        sqlite3.Error: The database cannot be read or written.
    """
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > len(migrations):
        raise NewerVersionError(f"version {version}, this program knows {len(migrations)}")
    for number, script in enumerate(migrations[version:], start=version + 1):
        connection.executescript(f"BEGIN IMMEDIATE; {script} PRAGMA user_version = {number}; COMMIT;")
    if not _expected_tables(migrations) <= _tables(connection):
        raise OtherTablesError("its tables differ from those of this version")


def _tables(connection: sqlite3.Connection) -> frozenset[tuple[str, str]]:
    return frozenset(connection.execute("SELECT name, sql FROM sqlite_master"))


@functools.cache
def _expected_tables(migrations: tuple[str, ...]) -> frozenset[tuple[str, str]]:
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript("".join(migrations))
        return _tables(connection)
