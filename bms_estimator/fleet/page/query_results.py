"""Query results for the page of a fleet. The page runs the queries at intervals in a thread."""

from pathlib import Path
from typing import Any

import duckdb

from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.model.errors import UserError

PAGE_QUERIES = ("soh", "failing", "outliers", "honest")
"""Names of the queries on the page."""
MAX_ROWS = 20
"""Maximum number of rows of a result."""


def answer(folder: Path, name: str) -> dict[str, Any]:
    """Return the result of one of the queries in ``PAGE_QUERIES``.

    Args:
        folder: Folder of the hours, as ``fleet collect`` writes it.
        name: Name of the query.

    Returns:
        ``columns``, the first ``rows``, and their number (``count``); or the reason why they are missing (``reason``).
    """
    try:
        found = run_query(folder, name)
    except (UserError, duckdb.Error) as error:
        return {"reason": str(error)}
    # The page shows only the rows of types of ``soh``, which have no pack.
    rows = [row for row in found.rows if name != "soh" or row[found.columns.index("pack")] is None]
    return {"columns": found.columns, "rows": rows[:MAX_ROWS], "count": len(rows)}
