"""Change of a pack's row in the table, as a message between the blocks of the pack.

The worker that owns a partition sends the changed rows of the table to the stream of the partition, and applies them when it reads
them there. Therefore a worker that takes over the partition applies each change between the same two blocks.

The message consists of ``MAGIC`` and a JSON object with the fields of ``PackSource``, or null if the pack was removed.
"""

import json
from typing import NamedTuple

from bms_estimator.edge.subjects import is_table_change

MAGIC = b"BMST"
"""First bytes of the message; those of a block differ."""


class PackSource(NamedTuple):
    """Texts that settings and model of a pack are made from."""

    row: str
    """Row of the table (JSON)."""
    cell_file: str | None
    """Content of the cell file; None for a shipped cell."""


def is_change(data: bytes) -> bool:
    """Return True if a message of the stream is a change of the table."""
    return data.startswith(MAGIC)


def trusted_data(subject: str, data: bytes) -> bytes:
    """Return the data of a stored message.

    A change of the table that an edge has sent as a block returns empty data, which is no block.
    """
    return b"" if is_change(data) and not is_table_change(subject) else data


def encode_change(source: PackSource | None) -> bytes:
    """Encode the change of a pack to a source; None: the pack is not in the table any more."""
    return MAGIC + json.dumps(None if source is None else source._asdict()).encode()


def decode_change(data: bytes) -> PackSource | None:
    """Decode the result of ``encode_change``.

    Raises:
        ValueError: The bytes are not a change of the table.
    """
    try:
        fields = json.loads(data.removeprefix(MAGIC))
        return None if fields is None else PackSource(**fields)
    except TypeError as error:
        raise ValueError(f"not a change of the table: {error}") from None
