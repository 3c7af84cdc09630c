"""Given load with fewer parts, so that the cost of a forecast does not depend on the resolution of a profile."""

import numpy as np

from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.model.arrays import Floats


def condense(load: GivenLoad, block_s: float) -> GivenLoad:
    """Return a load in which short parts are joined. Mean and peak of each block remain, because a peak may end the discharge.

    Of the parts that begin within a block of ``block_s``, the one with the largest load becomes the last part. The mean of the
    others becomes the first part.

    Args:
        load: Load; either all parts have a current, or all have a power.
        block_s: Length of a block [s].
    """
    ends_s = np.cumsum(load.duration_s)
    block = np.floor((ends_s - load.duration_s) / block_s)
    values = load.power_w if np.isnan(load.current_a).all() else load.current_a
    order = np.lexsort((values, block))
    duration_s, values, block = load.duration_s[order], values[order], block[order]
    first = np.flatnonzero(np.diff(block, prepend=-1.0))
    peak = np.append(first[1:], block.size) - 1
    others_s = np.add.reduceat(duration_s, first) - duration_s[peak]
    others_sum = np.add.reduceat(duration_s * values, first) - duration_s[peak] * values[peak]
    mean = np.divide(others_sum, others_s, out=np.zeros(first.size), where=peak > first)
    mean = np.minimum(mean, values[peak])  # after rounding
    joined_s = _alternate(np.where(peak > first, others_s, 0.0), duration_s[peak])
    joined = _alternate(mean, values[peak])[joined_s > 0.0]
    joined_s, unknown = joined_s[joined_s > 0.0], np.full(joined.size, np.nan)
    if np.isnan(load.current_a).all():
        return GivenLoad(joined_s, current_a=unknown, power_w=joined)
    return GivenLoad(joined_s, current_a=joined, power_w=unknown)


def _alternate(first: Floats, second: Floats) -> Floats:
    """Return the elements of two arrays of shape (n,) in turn, shape (2 n,)."""
    return np.stack([first, second], axis=1).ravel()
