"""One sample of a battery: what every source yields and the estimator takes.

Samples travel in blocks, numpy structured arrays of dtype ``SAMPLE``: what one read of the serial
descriptor brought, or some thousand rows of a file. A block of one is a sample.
"""

from enum import IntFlag
from typing import Literal

import numpy as np
from numpy.typing import NDArray

SAMPLE = np.dtype(
    [
        ("time_s", "f8"),  # the stream's own clock; never decreasing in a good stream
        ("current_a", "f8"),  # positive on discharge
        ("voltage_v", "f8"),  # pack terminals
        ("temperature_c", "f8"),  # NaN where there is no sensor
        ("status", "u4"),  # bits of SampleStatus
    ],
    align=True,
)

CurrentSign = Literal["discharge_positive", "charge_positive"]
"""Direction of the current that a device reports as positive."""

SampleBlock = NDArray[np.void]
"""Shape (n,), dtype ``SAMPLE``."""

CellBlock = NDArray[np.float64]
"""Shape (n, m): voltages of m cells for each of a block's n samples [V], NaN if not reported."""

NO_CELLS: CellBlock = np.empty((0, 0))
"""Cell voltages of a block without any, of any length."""

MIN_C, MAX_C = -60.0, 200.0
"""Maximum plausible temperature of a pack or stack [degC]."""
MIN_CELL_V, MAX_CELL_V = -5.0, 10.0
"""No single cell has a voltage beyond, be it reversed [V]."""


class SampleStatus(IntFlag):
    """Status bits of a sample."""

    VOLTAGE_SATURATED = 1
    CURRENT_SATURATED = 2
    OVERRUN = 4
    RESET = 8
    GAP = 16


def forget_beyond(values: NDArray[np.float64], least: float, most: float) -> int:
    """Replace, in place, values outside ``least``..``most`` with NaN. Returns how many there were."""
    beyond = (values < least) | (values > most)
    values[beyond] = np.nan
    return int(np.count_nonzero(beyond))
