"""The tables of a pack's database, and how older ones become them."""

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
"""Statements that migrate version n to version n + 1; a released one is never changed."""


class NewerVersionError(Exception):
    """A later version wrote this database."""


class OtherTablesError(Exception):
    """The tables are not those that were made."""


def migrate(connection: sqlite3.Connection, migrations: tuple[str, ...] = MIGRATIONS) -> None:
    """Bring a database to this version; a new one is empty.

    Args:
        connection: To the database.
        migrations: What makes its tables, as ``MIGRATIONS``.

    Raises:
        NewerVersionError: It is beyond this version.
        OtherTablesError: The tables were changed.
        sqlite3.Error: It cannot be read or written.
    """
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > len(migrations):
        raise NewerVersionError(f"version {version}, this program knows {len(migrations)}")
    for number, script in enumerate(migrations[version:], start=version + 1):
        connection.executescript(f"BEGIN IMMEDIATE; {script} PRAGMA user_version = {number}; COMMIT;")
    if not _wanted(migrations) <= _tables(connection):
        raise OtherTablesError("its tables are not those that were made")


def _tables(connection: sqlite3.Connection) -> frozenset[tuple[str, str]]:
    return frozenset(connection.execute("SELECT name, sql FROM sqlite_master"))


@functools.cache
def _wanted(migrations: tuple[str, ...]) -> frozenset[tuple[str, str]]:
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript("".join(migrations))
        return _tables(connection)
