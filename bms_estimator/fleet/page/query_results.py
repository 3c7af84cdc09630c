"""Query results for the page of a fleet: each query runs at intervals, off the event loop."""

from pathlib import Path
from typing import Any

import duckdb

from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.model.errors import UserError

ASKED = ("soh", "failing", "outliers", "honest")
"""Queries of the page."""
LISTED = 20
"""Rows of an answer, at most."""


def answer(folder: Path, name: str) -> dict[str, Any]:
    """Return the result of one of the queries in ``ASKED``.

    Args:
        folder: Folder of the hours, as ``fleet collect`` writes it.
        name: Name of the question.

    Returns:
        ``columns``, the first ``rows``, and their number (``count``); or the reason why they are missing (``reason``).
    """
    try:
        found = run_query(folder, name)
    except (UserError, duckdb.Error) as error:
        return {"reason": str(error)}
    rows = [row for row in found.rows if name != "soh" or row[found.columns.index("pack")] is None]
    return {"columns": found.columns, "rows": rows[:LISTED], "count": len(rows)}
