"""Array and record types of kernels and their callers."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of floats."""
Record = Any
"""Element of a structured array in a kernel. Its type is Any, because only numba resolves its fields."""
Records = NDArray[np.void]
"""Structured array."""


def exp(exponents: Floats) -> Floats:
    """Return e^x of each value by the C library, as kernels compute it. The last bit of ``np.exp`` depends on the CPU."""
    return np.array([math.exp(x) for x in exponents.flat]).reshape(exponents.shape)


def structured_array(columns: Mapping[str, Floats]) -> Records:
    """Return columns of equal length as the fields of a structured array of floats."""
    rows = np.empty(len(next(iter(columns.values()))), dtype=[(name, "f8") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


def fields(record: Records, prefix: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and view of each field of a structured array, recursively as ``part.field``."""
    for name in record.dtype.names or ():
        if record[name].dtype.names:
            yield from fields(record[name], f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", record[name]
