"""Array and record types of kernels and their callers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of floats."""
Record = Any
"""Element of a structured array in a kernel. Its type is Any, because only numba resolves its fields."""
Records = NDArray[np.void]
"""Structured array."""


def structured_array(columns: Mapping[str, Floats]) -> Records:
    """Return columns of equal length as the fields of a structured array of floats."""
    rows = np.empty(len(next(iter(columns.values()))), dtype=[(name, "f8") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows
