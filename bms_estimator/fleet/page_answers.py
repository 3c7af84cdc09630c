"""What the hours of a fleet answer, for its page: each question asked now and then, off the event loop."""

import json
from pathlib import Path
from typing import Any

import duckdb

from bms_estimator.fleet.questions import ask
from bms_estimator.model.errors import UserError

ASKED = ("soh", "failing", "outliers", "honest")
"""Of the questions."""
LISTED = 20
"""Rows of an answer, at most."""


def answers(folder: Path) -> str:
    """The answer to each, JSON in one line.

    Args:
        folder: Of the hours, as ``fleet collect`` writes it.

    Returns:
        By question ``columns``, the first ``rows``, and how many there are (``count``); or why there is none (``reason``).
    """
    found = {name: _answer(folder, name) for name in ASKED}
    return json.dumps(found, allow_nan=False, separators=(",", ":"))


def _answer(folder: Path, name: str) -> dict[str, Any]:
    try:
        answer = ask(folder, name)
    except (UserError, duckdb.Error) as error:
        return {"reason": str(error)}
    rows = [row for row in answer.rows if name != "soh" or row[answer.columns.index("pack")] is None]
    return {"columns": answer.columns, "rows": rows[:LISTED], "count": len(rows)}
