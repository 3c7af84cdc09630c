"""Reader of a pack's history. It can run while the service writes the history."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.errors import UserError
from bms_estimator.store.history import MINUTE_S, Minute
from bms_estimator.store.migrations import MIGRATIONS

_QUANTITIES = ("voltage", "v"), ("current", "a"), ("temperature", "c")
_SUMS = "sum(charge_out_ah), sum(charge_in_ah), sum(energy_out_wh), sum(energy_in_wh), sum(seen_s), sum(publications)"
_DAMAGED = "the service moves a damaged file aside at its next start, and begins a new one"
"""Remedy for a damaged file."""


class PastEvent(NamedTuple):
    """Event in a pack's history."""

    time_s: float
    """Seconds since 1970."""
    name: str
    text: str


class HistoryReader:
    """History database of a pack, opened read-only.

    Args:
        path: Database file of the service.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def rows(self, since_s: float, until_s: float, step_s: int) -> list[Minute]:
        """Return rows of length ``step_s``, aggregated from one-minute rows. Intervals without publications are omitted.

        Args:
            since_s: Start time [s since 1970].
            until_s: End time, exclusive [s since 1970].
            step_s: Length of a row [s], whole minutes. With 60 s, a minute gives two rows if it passed twice because the
                clock was set back.

        Raises:
            UserError: The history cannot be read.
        """
        begin = "time_s" if step_s == MINUTE_S else "time_s / :step * :step"
        columns = ", ".join([begin, *(_mean_and_extremes(*quantity) for quantity in _QUANTITIES)])
        grouped = (
            f"SELECT {columns}, {_SUMS}, max(time_s) AS last_s FROM minute "  # noqa: S608 - only constant names
            f"WHERE time_s >= :since AND time_s < :until GROUP BY {begin}"
        )
        query = f"SELECT g.*, m.soc, m.soc_std FROM ({grouped}) AS g JOIN minute AS m ON m.time_s = g.last_s ORDER BY 1"  # noqa: S608
        with self._reading() as connection:
            rows = connection.execute(query, {"since": since_s, "until": until_s, "step": step_s}).fetchall()
        # columns: 10 of time, means and extremes, 6 of sums, last_s, and 2 of SOC, which precede the sums in ``Minute``
        return [Minute._make((*row[:10], *row[-2:], *row[10:16])) for row in rows]

    def events(self, since_s: float, until_s: float) -> list[PastEvent]:
        """Return the events, oldest first.

        Args:
            since_s: Start time [s since 1970].
            until_s: End time, exclusive [s since 1970].

        Raises:
            UserError: The history cannot be read.
        """
        query = "SELECT time_s, name, text FROM event WHERE time_s >= ? AND time_s < ? ORDER BY time_s, number"
        with self._reading() as connection:
            return [PastEvent(*row) for row in connection.execute(query, (since_s, until_s))]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        """Open the file read-only; convert its errors to a UserError."""
        self._require_readable()
        try:
            with closing(sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
                (version,) = connection.execute("PRAGMA user_version").fetchone()
                if version > len(MIGRATIONS):
                    raise UserError(f"{self._path}: written by a later version of bms_estimator; read it with that one")
                if version == 0:
                    raise UserError(f"{self._path}: not a history: the file has no tables; {_DAMAGED}")
                yield connection
        except (
            sqlite3.OperationalError
        ) as error:  # for example locked, or without permission to write the shared memory
            raise UserError(f"{self._path}: history cannot be read: {error}") from error
        except sqlite3.Error as error:
            raise UserError(f"{self._path}: history cannot be read: {error}; {_DAMAGED}") from error

    def _require_readable(self) -> None:
        """Raise a UserError if the file does not exist or cannot be opened."""
        try:
            with self._path.open("rb"):
                return
        except (FileNotFoundError, NotADirectoryError) as error:
            raise UserError(
                f"{self._path}: no history there: the service has not run yet, or with another state folder"
            ) from error
        except PermissionError as error:
            raise UserError(
                f"{self._path}: no permission to read the history: run the command as the user of the service, or with sudo"
            ) from error
        except OSError as error:
            raise UserError(f"{self._path}: history cannot be read: {error.strerror}") from error


def _mean_and_extremes(quantity: str, unit: str) -> str:
    """Return SQL of mean and extremes of a quantity over one-minute rows."""
    mean, minimum, maximum = (f"{quantity}_{part}{unit}" for part in ("", "min_", "max_"))
    weight = f"sum(CASE WHEN {mean} IS NULL THEN 0 ELSE publications END)"
    return f"sum({mean} * publications) / {weight}, min({minimum}), max({maximum})"
