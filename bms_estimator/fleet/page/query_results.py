"""Query results for the page of a fleet."""

from pathlib import Path
from typing import Any

import duckdb

from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.model.errors import UserError

PAGE_QUERIES = ("failing", "soh", "outliers", "honest")
"""Names of the queries on the page."""
MAX_ROWS = 20
"""Maximum number of rows of a result."""


def run_page_query(folder: Path, name: str) -> dict[str, Any]:
    """Return the result of one of the queries in ``PAGE_QUERIES``.

    Args:
        folder: Folder of the hours, as ``fleet collect`` writes it.
        name: Name of the query.

    Returns:
        ``columns``, the first ``rows``, their number (``count``), and ``notes``; or the reason why they are missing (``reason``).
    """
    try:
        result = run_query(folder, name)
    except (UserError, duckdb.Error, OSError) as error:
        return {"reason": str(error)}
    # the page shows only the rows of ``soh`` that are for a type; these have no pack
    rows = [row for row in result.rows if name != "soh" or row[result.columns.index("pack")] is None]
    return {"columns": result.columns, "rows": rows[:MAX_ROWS], "count": len(rows), "notes": result.notes}
