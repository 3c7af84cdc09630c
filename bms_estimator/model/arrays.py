"""Types of arrays and records that kernels and their callers share."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Record = Any
"""An element of a structured array inside a kernel: numba resolves its fields, the type checker does not."""
Records = NDArray[np.void]
"""A structured array."""
