"""Vector of the slow fit's unknowns.

SOC at the start, offset and capacity are unknowns of each interval of about a day. Offset and capacity change little from one
interval to the next.
"""

from dataclasses import dataclass

import numpy as np

CURVE_NODES, DIRECTION_NODES, SHAPE_NODES = 101, 51, 6
"""Number of SOC nodes of the OCV's error, of the error by direction, and of the error of the resistances."""
DIRECTIONS = 3
"""Charge, rest and discharge."""
RESISTANCE_GROUPS = (0, 1, 1, 1, 2, 2, 2)
"""Group of each resistance: 0 series resistance, 1 RC pairs up to 30 s, 2 slower RC pairs. Those of a group share a scale."""
SCALES = 1 + RESISTANCE_GROUPS[-1]
"""Number of groups of resistances."""


@dataclass(frozen=True)
class Unknowns:
    """Positions of the unknowns in their vector, for K intervals and S segments."""

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
    start_hysteresis: slice
    """Fast and slow part of the hysteresis at the start of each segment."""
    start_load: slice
    """Load before the start of each segment, when the RC pairs are reset, in std (``prediction.START_LOAD_C``)."""
    entropy: slice
    """Error of the OCV's temperature coefficient [V/K]."""
    arrhenius: slice
    """Error of the relative change of the resistances by temperature [1/K]."""
    full: slice
    """1 minus the SOC at which this pack's charger ends."""
    curve: slice
    """Error of the file's OCV at ``CURVE_NODES`` SOCs [V]."""
    direction: slice
    """Error by direction at ``DIRECTION_NODES`` SOCs, for charge, rest and discharge, relative to its std."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.direction.stop)

    @classmethod
    def of(cls, intervals: int, segments: int) -> "Unknowns":
        """Return the positions for a number of intervals and segments."""
        sizes = (intervals, intervals, intervals, SCALES, 1, SHAPE_NODES, 2, 2 * segments, segments, 1, 1, 1)
        ends = np.cumsum([*sizes, CURVE_NODES, DIRECTIONS * DIRECTION_NODES]).tolist()
        return cls(*(slice(a, b) for a, b in zip([0, *ends], ends, strict=False)))
