"""Decoder of a telemetry batch in JSON or Arrow IPC. No I/O."""

import json
from typing import Any

from bms_estimator.fleet.ingest.batch_columns import BatchColumns, BatchError, check_count
from bms_estimator.sources.captures.tables.layout import REQUIRED

_ARROW_STREAM, _ARROW_FILE = b"\xff\xff\xff\xff", b"ARROW1"
"""First bytes of an Arrow IPC stream and of an Arrow IPC file."""


def decode_batch(payload: bytes) -> BatchColumns:
    """Return the columns of a batch.

    Args:
        payload: Arrow IPC, or a JSON object: of lists, one for each column; of single values; or a list of objects, one for
            each row.

    Raises:
        BatchError: The bytes are none of these, or the columns differ in length.
    """
    if payload.startswith((_ARROW_STREAM, _ARROW_FILE)):
        from bms_estimator.fleet.ingest.arrow_batch import decode_arrow  # noqa: PLC0415 - JSON needs no Arrow

        return decode_arrow(payload[8:] if payload.startswith(_ARROW_FILE) else payload)
    try:
        document = json.loads(payload, object_pairs_hook=_unique_members)
    except BatchError:
        raise
    except (ValueError, RecursionError) as error:
        raise BatchError(f"neither JSON nor Arrow IPC: {error}") from None
    columns = _columns_of_rows(document) if isinstance(document, list) else _columns_of_object(document)
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise BatchError(f"the columns differ in length: {lengths}")
    return columns


def _unique_members(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object.

    Raises:
        BatchError: Several members have the same name.
    """
    document = dict(members)
    if len(document) < len(members):
        raise BatchError("several columns have the same name")
    return document


def _columns_of_object(document: object) -> BatchColumns:
    """Return the columns of an object.

    An object with enough lists for a sample has one list for each column, and its other values are ignored. Any other object is
    one row.
    """
    if not isinstance(document, dict) or not document:
        raise BatchError("must be an object of columns or a list of rows")
    lists = {name: values for name, values in document.items() if isinstance(values, list)}
    return lists if len(lists) >= len(REQUIRED) else {name: [value] for name, value in document.items()}


def _columns_of_rows(rows: list[Any]) -> BatchColumns:
    """Return the columns of a list of rows. A row may lack columns of the first row."""
    if not rows:
        raise BatchError("has no rows")
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict):
            raise BatchError(f"row {number} is no object with the names of columns")
    check_count(len(rows) * len(rows[0]))
    return {name: [row.get(name) for row in rows] for name in rows[0]}
