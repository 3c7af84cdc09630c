"""Monotone cubic interpolation (PCHIP), bit for bit the same as ``scipy.interpolate.PchipInterpolator``.

It replaces scipy in the service, which needs no other function of it. scipy takes 140 MB on disk.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bms_estimator.model.arrays import Floats


class MonotoneCubic:
    """Piecewise cubic Hermite interpolation that rises and falls only where the points do.

    Args:
        x: Shape (n,), increasing, at least two values.
        y: Shape (n,).
    """

    def __init__(self, x: ArrayLike, y: ArrayLike) -> None:
        self._x: Floats = np.asarray(x, dtype=np.float64)
        y_at: Floats = np.asarray(y, dtype=np.float64)
        width = np.diff(self._x)
        secant = np.diff(y_at) / width
        slope = _slopes(width, secant)
        excess = (slope[:-1] + slope[1:] - 2.0 * secant) / width
        # coefficients of (x - x[i])^0 to (x - x[i])^3
        self._c = (y_at[:-1], slope[:-1], (secant - slope[:-1]) / width - excess, excess / width)

    def __call__(self, x: Floats) -> Floats:
        """Return y at ``x``. The outer pieces extend beyond the points."""
        i, s = self._locate(x)
        c0, c1, c2, c3 = (c[i] for c in self._c)
        return np.asarray(c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s), dtype=np.float64)

    def derivative(self, x: Floats) -> Floats:
        """Return dy/dx at ``x``."""
        i, s = self._locate(x)
        _, c1, c2, c3 = (c[i] for c in self._c)
        return np.asarray(c1 + c2 * 2.0 * s + c3 * 3.0 * (s * s), dtype=np.float64)

    def _locate(self, x: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return the index of each value's piece, and the distance from the beginning of the piece."""
        x = np.asarray(x, dtype=np.float64)
        i = np.clip(np.searchsorted(self._x, x, side="right") - 1, 0, self._x.size - 2)
        return i, x - self._x[i]


def _slopes(width: Floats, secant: Floats) -> Floats:
    """Return dy/dx at each point: the weighted harmonic mean of the secants beside it, or 0 at an extremum."""
    if secant.size == 1:
        return np.array([secant[0], secant[0]])
    before, after = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    is_extremum = (np.sign(secant[1:]) != np.sign(secant[:-1])) | (secant[1:] == 0.0) | (secant[:-1] == 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):  # at an extremum
        inner = 1.0 / ((before / secant[:-1] + after / secant[1:]) / (before + after))
    first = _slope_at_end(width[0], width[1], secant[0], secant[1])
    last = _slope_at_end(width[-1], width[-2], secant[-1], secant[-2])
    return np.concatenate([[first], np.where(is_extremum, 0.0, inner), [last]])


def _slope_at_end(width: float, next_width: float, secant: float, next_secant: float) -> float:
    """Return dy/dx at an end point, limited so that the end piece is monotone."""
    slope = ((2.0 * width + next_width) * secant - width * next_secant) / (width + next_width)
    if np.sign(slope) != np.sign(secant):
        return 0.0
    if np.sign(secant) != np.sign(next_secant) and abs(slope) > 3.0 * abs(secant):
        return 3.0 * secant
    return slope
