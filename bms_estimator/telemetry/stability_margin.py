"""Stability margin, and the reason for its absence."""

import math
from typing import Any

import numpy as np

UNKNOWN_SOC = "the SOC is not known yet: charge the pack to full once, or let it rest for ten minutes"
"""Reason without a known SOC, and what helps."""
ALWAYS_STABLE = "the thesis's model is valid at each SOC: delta_1 and delta_2 are not above 0"
"""Reason with capacitances that are positive at each SOC."""
NOT_IDENTIFIED = "delta_1 and delta_2 follow from a7..a12, which are not valid: see the topic parameters"
"""Reason without a valid shape of the capacitances over SOC."""


def known_margin(trace: Any, soc_known: Any) -> Any:
    """Return the stability margin of rows of dtype TRACE, NaN without a margin or a known SOC.

    Args:
        trace: One row, or shape (n,).
        soc_known: True where the SOC is known, of the same shape.
    """
    return np.where(soc_known, trace["stability_margin"], np.nan)


def missing_margin_reason(row: np.void, *, soc_known: bool) -> str | None:
    """Return the reason why a battery has no stability margin; None if it has one, and for a fuel cell.

    Args:
        row: Estimate, dtype TRACE.
        soc_known: True if its SOC is known.
    """
    if math.isnan(row["soc"]):
        return None
    if math.isnan(row["stability_margin"]):
        return NOT_IDENTIFIED if max(row["delta_1"], row["delta_2"]) > 0.0 else ALWAYS_STABLE
    return None if soc_known else UNKNOWN_SOC
