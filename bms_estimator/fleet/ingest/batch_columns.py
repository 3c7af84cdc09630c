"""Columns of a telemetry batch."""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

Values = Sequence[Any] | NDArray[Any]
"""Values of a column: numbers, texts, ``datetime64`` timestamps, or one list of cell voltages for each row."""
BatchColumns = Mapping[str, Values]
"""Columns of equal length by name."""

MAX_VALUES = 1 << 20
"""Maximum number of values in a batch. An uncompressed message of 1 MiB cannot hold more numbers of one byte each."""


class BatchError(ValueError):
    """Error in a batch, with the reason."""


def check_count(values: int) -> None:
    """Check the number of values of a batch, before memory for them is allocated.

    Raises:
        BatchError: The number exceeds ``MAX_VALUES``.
    """
    if values > MAX_VALUES:
        raise BatchError(f"{values:,} values: must be at most {MAX_VALUES:,}; send smaller batches")
