"""Thinning of long lines for plots."""

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import Floats

MAX_POINTS = 1200
"""Maximum number of points on a line. More points are not visible at the width of a figure."""
MIN_STEP = 0.05
"""Minimum change between two samples that counts as a step, as a fraction of the curve's range. A step whose first sample
is missing would be drawn as a ramp."""


def thin(x: Floats, *curves: Floats, points: int = MAX_POINTS) -> tuple[Floats, ...]:
    """Reduce the points of curves. The extremes and the largest steps remain.

    An increasing abscissa is divided into intervals of equal width; otherwise the samples are divided into intervals of equal
    size. The first sample of each interval remains, and so do the samples with the minimum and the maximum of each curve.
    Both samples of the largest steps remain, too. NaN is neither a minimum nor a maximum.

    Args:
        x: Shape (n,), common abscissa.
        *curves: Each of shape (n,).
        points: Approximate number of points of the result, which are at most ``1.5 * points + 1``.

    Returns:
        Abscissa and curves, all of the same reduced length.
    """
    if x.size <= points:
        return (x, *curves)
    kept = kept_indices(x, curves, points)
    return (x[kept], *(curve[kept] for curve in curves))


def kept_indices(x: Floats, curves: tuple[Floats, ...], points: int) -> NDArray[np.int64]:
    """Return the increasing indices of the samples that ``thin`` keeps."""
    size = x.size
    first = _first_indices(x, max(points // (1 + 2 * len(curves)), 1))
    last = np.append(first[1:], size)
    indices = [first, np.array([size - 1]), _step_indices(curves, points // 4)]
    for curve in curves:
        for find, missing in ((np.argmin, np.inf), (np.argmax, -np.inf)):
            intervals = (np.nan_to_num(curve[a:b], nan=missing) for a, b in zip(first, last, strict=True))
            indices.append(first + [find(values) for values in intervals])
    return np.unique(np.concatenate(indices))


def _first_indices(x: Floats, intervals: int) -> NDArray[np.int64]:
    """Return the increasing indices of the first sample of each interval; intervals without a sample have none."""
    if (x[1:] >= x[:-1]).all():
        return np.unique(np.searchsorted(x, np.linspace(x[0], x[-1], intervals + 1)[:-1]))
    return np.linspace(0, x.size, intervals, endpoint=False).astype(np.int64)


def _step_indices(curves: tuple[Floats, ...], max_steps: int) -> NDArray[np.int64]:
    """Return the indices of both samples of the largest steps of all curves, in any order."""
    begins, sizes = [], []
    for curve in curves:
        values = curve[np.isfinite(curve)]
        spread = np.ptp(values) if values.size else 0.0
        with np.errstate(invalid="ignore"):  # infinite values
            changes = np.nan_to_num(np.abs(np.diff(curve)), posinf=0.0)
        begins.append(np.flatnonzero(changes > MIN_STEP * spread))
        sizes.append(changes[begins[-1]] / spread)
    largest = np.concatenate(begins)[np.argsort(-np.concatenate(sizes), kind="stable")[:max_steps]]
    return np.concatenate([largest, largest + 1])
