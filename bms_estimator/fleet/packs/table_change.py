"""Change of a pack's row in the table, as a message between the blocks of the pack.

The worker that owns a partition sends the changed rows of the table to the stream of the partition, and applies them when it reads
them there. Therefore a worker that takes over the partition applies each change between the same two blocks.

The message consists of ``MAGIC`` and a JSON object with the fields of ``PackSource``, or null if the pack was removed.
"""

import json
from typing import NamedTuple

MAGIC = b"BMST"
"""First bytes of the message, different from those of a block."""


class PackSource(NamedTuple):
    """Row and cell file from which the settings and the model of a pack are built."""

    row: str
    """Row of the table (JSON)."""
    cell_file: str | None
    """Content of the cell file; None for a shipped cell."""


def is_change(data: bytes) -> bool:
    """Return True if a message of the stream is a change of the table."""
    return data.startswith(MAGIC)


def encode_change(source: PackSource | None) -> bytes:
    """Encode a change of the table.

    Args:
        source: New row and cell file of the pack; None if the pack was removed from the table.
    """
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
