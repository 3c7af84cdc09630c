"""Vector of the slow fit's unknowns.

SOC at the start, offset and capacity are unknowns of each interval of about a day. Offset and capacity change little from one
interval to the next. The unknowns of one segment are the first, because their equations are sparse (``solve.cholesky``).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.pack_voltage import CURVE_NODES, DIRECTION_NODES, RESISTANCE_GROUPS, SHAPE_NODES

DIRECTIONS = 3
"""Charge, rest and discharge."""
SCALES = 1 + RESISTANCE_GROUPS[-1]
"""Number of groups of resistances."""


@dataclass(frozen=True)
class Unknowns:
    """Positions of the unknowns in their vector, for K intervals and S segments."""

    start_hysteresis: slice
    """Fast and slow part of the hysteresis at the start of each segment."""
    start_load: slice
    """Load before the start of each segment, when the RC pairs are reset, in std (``prediction.START_LOAD_C``)."""
    soc: slice
    """SOC at the start of each interval."""
    offset: slice
    """Offset of the current sensor in each interval [C-rate of the declared capacity]."""
    ln_q: slice
    """ln of the true over the declared capacity in each interval."""
    ln_r: slice
    """ln of the true over the file's resistances in the last interval: series resistance, RC pairs 1-3, RC pairs 4-6."""
    aging: slice
    """Factor on ``AgingVariance.trend``: change of ln of the resistances over the history by aging, in std."""
    shape: slice
    """Error of ln of all resistances at ``SHAPE_NODES`` SOCs, added to ``ln_r``."""
    hysteresis: slice
    """Factors on the file's hysteresis in its fast and in its slow part."""
    entropy: slice
    """Error of the OCV's temperature coefficient [V/K]."""
    arrhenius: slice
    """Error of the relative change of the resistances with temperature [1/K]."""
    full: slice
    """1 minus the SOC at which this pack's charger ends."""
    curve: slice
    """Error of the file's OCV at ``CURVE_NODES`` SOCs [V]."""
    direction: slice
    """Direction-dependent error at ``DIRECTION_NODES`` SOCs, for charge, rest and discharge, relative to its std."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.direction.stop)

    @property
    def first(self) -> NDArray[np.intp]:
        """First column of each kind of unknown on which a voltage depends, in the order of ``pack_voltage``."""
        return np.array([part.start for part in (
            self.start_hysteresis, self.start_load, self.soc, self.offset, self.ln_q, self.ln_r, self.aging, self.shape,
            self.hysteresis, self.entropy, self.arrhenius, self.curve, self.direction)], np.intp)  # fmt: skip

    @classmethod
    def of(cls, intervals: int, segments: int) -> "Unknowns":
        """Return the positions for a number of intervals and segments."""
        sizes = (2 * segments, segments, intervals, intervals, intervals, SCALES, 1, SHAPE_NODES, 2, 1, 1, 1)
        ends = np.cumsum([*sizes, CURVE_NODES, DIRECTIONS * DIRECTION_NODES]).tolist()
        return cls(*(slice(a, b) for a, b in zip([0, *ends], ends, strict=False)))
