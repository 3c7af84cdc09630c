"""Decision whether the SOC is known: whether its estimate is certain enough to be shown and judged."""

import numpy as np

from bms_estimator.model.arrays import Records
from bms_estimator.numba_cache import njit

MAX_KNOWN_STD = 0.15
"""Std of the SOC above which a known SOC becomes unknown. Its band of two std then covers more than half of the range."""
MIN_UNKNOWN_STD = 0.12
"""Std of the SOC below which an unknown SOC becomes known. The distance to ``MAX_KNOWN_STD`` prevents frequent changes."""


@njit(cache=True)
def is_soc_known(soc_std: float, was_known: bool) -> bool:
    """Return True if an SOC with this std is known. An SOC from coulomb counting alone has no std and counts as known.

    Args:
        soc_std: Std of the SOC; NaN without the identifier.
        was_known: Decision at the previous sample; False at the first one.
    """
    if soc_std > MAX_KNOWN_STD:
        return False
    return was_known or not soc_std >= MIN_UNKNOWN_STD


@njit(cache=True)
def known_rows(trace: Records, was_known: bool) -> np.ndarray:
    """Return ``is_soc_known`` at each row of dtype TRACE, shape (n,), bool."""
    known = np.empty(trace.shape[0], np.bool_)
    for j in range(trace.shape[0]):
        was_known = is_soc_known(trace[j].soc_std, was_known)
        known[j] = was_known
    return known
