"""Columns of a telemetry batch."""

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

Values = Sequence[Any] | NDArray[Any]
"""Values of a column: numbers, texts, or ``datetime64`` of a column of timestamps; one list for each row of cell voltages."""
BatchColumns = Mapping[str, Values]
"""Columns of equal length by name."""


class BatchError(ValueError):
    """Error in a batch, with the reason."""
