"""Reading a pack's history, while the service writes it or not."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from bms_estimator.model.errors import UserError
from bms_estimator.store.migrations import MIGRATIONS
from bms_estimator.store.minute import MINUTE_S, Minute

_SUMMED = "sum(charge_out_ah), sum(charge_in_ah), sum(energy_out_wh), sum(energy_in_wh), sum(seen_s), sum(publications)"


class PastEvent(NamedTuple):
    """Something that happened."""

    time_s: float
    """Seconds since 1970."""
    name: str
    text: str


class HistoryFile:
    """A pack's history.

    Args:
        path: The database of the service.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def rows(self, since_s: float, until_s: float, step_s: int) -> list[Minute]:
        """Minutes put together, those without a publication left out.

        Args:
            since_s: Start time [s since 1970].
            until_s: To before [s since 1970].
            step_s: Length of a row [s], whole minutes; one minute has two rows if the clock went through it twice.

        Raises:
            UserError: It cannot be read.
        """
        begin = "time_s" if step_s == MINUTE_S else "time_s / :step * :step"  # rows of one minute stay apart
        columns = f"{begin}, {_mean('voltage', 'v')}, {_mean('current', 'a')}, {_mean('temperature', 'c')}"
        grouped = (
            f"SELECT {columns}, {_SUMMED}, max(time_s) AS last_s FROM minute "  # noqa: S608 - names of ours
            f"WHERE time_s >= :since AND time_s < :until GROUP BY {begin}"
        )
        query = f"SELECT g.*, m.soc, m.soc_std FROM ({grouped}) AS g JOIN minute AS m ON m.time_s = g.last_s ORDER BY 1"  # noqa: S608
        with self._reading() as connection:
            found = connection.execute(query, {"since": since_s, "until": until_s, "step": step_s}).fetchall()
        return [Minute._make((*row[:10], *row[-2:], *row[10:16])) for row in found]

    def events(self, since_s: float, until_s: float) -> list[PastEvent]:
        """Yield the events, oldest first.

        Args:
            since_s: Start time [s since 1970].
            until_s: To before [s since 1970].

        Raises:
            UserError: It cannot be read.
        """
        query = "SELECT time_s, name, text FROM event WHERE time_s >= ? AND time_s < ? ORDER BY time_s, number"
        with self._reading() as connection:
            return [PastEvent(*row) for row in connection.execute(query, (since_s, until_s))]

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        if not self._path.is_file():
            raise UserError(
                f"{self._path}: no history there: the service has not run yet, or with another state folder"
            )
        try:
            with closing(sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
                (version,) = connection.execute("PRAGMA user_version").fetchone()
                if version > len(MIGRATIONS):
                    raise UserError(f"{self._path}: written by a later version of bms_estimator; read it with that one")
                yield connection
        except sqlite3.Error as error:
            raise UserError(f"{self._path}: history cannot be read: {error}") from error


def _mean(quantity: str, unit: str) -> str:
    """Return SQL of mean and extremes of a quantity over one-minute rows."""
    mean, least, most = (f"{quantity}_{part}{unit}" for part in ("", "min_", "max_"))
    weight = f"sum(CASE WHEN {mean} IS NULL THEN 0 ELSE publications END)"
    return f"sum({mean} * publications) / {weight}, min({least}), max({most})"
