"""Array and record types of kernels and their callers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of floats."""
Record = Any
"""Element of a structured array in a kernel. Its type is Any, because only numba resolves its fields."""
Records = NDArray[np.void]
"""Structured array."""
