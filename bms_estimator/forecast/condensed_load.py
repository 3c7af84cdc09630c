"""Reduction of a given load to fewer parts, so that a profile with a high resolution does not slow down a forecast."""

import numpy as np

from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.model.arrays import Floats


def condense(load: GivenLoad, block_s: float) -> GivenLoad:
    """Return a load whose short parts are merged. Mean and peak of each block remain, because a peak may end the discharge.

    The parts that begin within a block become two parts: the mean of all but the largest load, and then the largest load.

    Args:
        load: Load; either all parts have a current, or all have a power.
        block_s: Length of a block [s].
    """
    ends_s = np.cumsum(load.duration_s)
    block = np.floor((ends_s - load.duration_s) / block_s)
    values = load.power_w if np.isnan(load.current_a).all() else load.current_a
    order = np.lexsort((values, block))  # by block, and within a block by load
    duration_s, values, block = load.duration_s[order], values[order], block[order]
    first = np.flatnonzero(np.diff(block, prepend=-1.0))
    peak = np.append(first[1:], block.size) - 1  # the last part of each block has its largest load
    others_s = np.add.reduceat(duration_s, first) - duration_s[peak]
    others_sum = np.add.reduceat(duration_s * values, first) - duration_s[peak] * values[peak]
    mean = np.divide(others_sum, others_s, out=np.zeros(first.size), where=peak > first)
    mean = np.minimum(mean, values[peak])  # rounding may lift the mean above the peak
    merged_s = _interleave(np.where(peak > first, others_s, 0.0), duration_s[peak])
    merged = _interleave(mean, values[peak])[merged_s > 0.0]
    merged_s, unknown = merged_s[merged_s > 0.0], np.full(merged.size, np.nan)
    if np.isnan(load.current_a).all():
        return GivenLoad(merged_s, current_a=unknown, power_w=merged)
    return GivenLoad(merged_s, current_a=merged, power_w=unknown)


def _interleave(first: Floats, second: Floats) -> Floats:
    """Return two arrays of shape (n,) interleaved, shape (2 n,)."""
    return np.stack([first, second], axis=1).ravel()
