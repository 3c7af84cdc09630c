"""Mittag-Leffler function E_a(-lambda k^a), 2 < a <= 3, of the Nussbaum gain.

The thesis prints (3.10) with a plus sign, which makes every term of (3.11) positive (erratum 1, docs/theory/thesis.md).
With the minus sign, (3.10) is a Nussbaum function (Li & Chen, Automatica 2009). With r = lambda^(1/a) k its exact value is

    E_a(-r^a) = (2/a) e^(r cos(pi/a)) cos(r sin(pi/a)) + G_a(r),
    G_a(r) = (sin(pi a)/pi) int_0^inf e^(-r s) s^(a-1) / (s^(2a) + 2 s^a cos(pi a) + 1) ds.

As a approaches 3, a pole of the integrand approaches the real axis. Substituting s^a = -cos(pi a) + sin(pi a) tan(theta) removes
it and turns G into a mean of exponentials:

    G_a(r) = 1/(pi a) int e^(-r s(theta)) d theta,    from s(theta) = 0 to s(theta) = inf.

This mean is tabulated over 1/(1 + r) once per a. Near r = 0, G is not smooth because of a term r^a. There, the power series
(3.11) is used.
"""

import math
from functools import lru_cache

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

SERIES_TERMS = 24
"""Number of terms of the series (3.11)."""
SERIES_LIMIT = 2.0
"""Maximum r for the series (3.11). Its terms stay below 2 there, so that no digits are lost."""
TABLE_POINTS = 1025
"""Number of nodes of G over w = 1/(1 + r) in [0, 1/(1 + SERIES_LIMIT)], for a cubic Hermite error below 1e-12."""
PANEL_NODES = 20
"""Number of quadrature nodes of a panel in theta. More nodes change G by less than rounding."""
PANELS = 60
"""Number of panels from s = 1 to each end. The last one is shorter than the resolution of theta in double precision."""
PANEL_RATIO = 0.4
"""Ratio of the distances of successive panel edges from the end of the range."""

_W_END = 1.0 / (1.0 + SERIES_LIMIT)


def series_coefficients(alpha: float) -> Floats:
    """Return the coefficients (-1)^k / Gamma(alpha k + 1) of the series (3.11) in r^alpha. Shape (SERIES_TERMS,)."""
    return np.array([(-1.0) ** j * math.exp(-math.lgamma(alpha * j + 1.0)) for j in range(SERIES_TERMS)])


@lru_cache(maxsize=8)  # 2 million exponentials; an alpha seldom changes
def decay_table(alpha: float) -> tuple[Floats, Floats]:
    """Return G_alpha and its derivative by w at ``TABLE_POINTS`` nodes of w = 1/(1 + r) in [0, 1/3].

    All callers share the arrays, which are read-only.

    Raises:
        ValueError: ``alpha`` is not in (2, 3], so that E_a(-lambda k^a) is no Nussbaum function.
    """
    if not 2.0 < alpha <= 3.0:
        raise ValueError(f"alpha = {alpha}: must be in (2, 3], where E_a(-lambda k^a) is a Nussbaum function")
    s, weight = _mean_of_exponentials(alpha)
    value, slope = np.zeros(TABLE_POINTS), np.zeros(TABLE_POINTS)
    _write_table(s, weight, value, slope)
    value.flags.writeable = slope.flags.writeable = False
    return value, slope


@njit(cache=True)
def _write_table(s: Floats, weight: Floats, value: Floats, slope: Floats) -> None:
    """Write G = sum(weight * exp(-r s)) and dG/dw at each node but the first, where r is infinite and both are zero."""
    for i in range(1, TABLE_POINTS):
        w = i * (_W_END / (TABLE_POINTS - 1))
        r = 1.0 / w - 1.0
        total = moment = 0.0
        for j in range(s.size):
            term = weight[j] * math.exp(-r * s[j])
            total += term
            moment += term * s[j]
        value[i], slope[i] = total, moment / w**2  # dG/dw = dG/dr * dr/dw, dr/dw = -1/w^2


def _mean_of_exponentials(alpha: float) -> tuple[Floats, Floats]:
    """Return nodes s and weights of G = sum(weight * exp(-r s)), by quadrature in panels of theta graded to both ends."""
    c, sine = math.cos(math.pi * alpha), abs(math.sin(math.pi * alpha))
    # theta runs from atan2(c, sine) (s = 0) to pi/2 (s = inf); z = s^alpha on a logarithmic scale has
    # d theta = sine dz / ((z + c)^2 + sine^2), smooth but for the peak at z = -c, which theta removes.
    theta_start = math.atan2(c, sine)
    theta_one = math.atan2(1.0 + c, sine)  # s = 1
    nodes, weights = _quadrature_rule()
    s_all, w_all = [], []

    for end in (theta_start, 0.5 * math.pi):
        # geometric panels from s = 1 towards the end: s ~ (theta - start)^(1/alpha) and s -> inf are singular there
        edge = theta_one
        for _ in range(PANELS):
            nearer = end + PANEL_RATIO * (edge - end)
            half = 0.5 * abs(edge - nearer)
            z = [max(sine * math.tan(theta) - c, 0.0) for theta in 0.5 * (edge + nearer) + half * nodes]
            s_all.append([each ** (1.0 / alpha) for each in z])
            w_all.append(half * weights / (math.pi * alpha))
            edge = nearer
    return np.concatenate(s_all), np.concatenate(w_all)


def _quadrature_rule() -> tuple[Floats, Floats]:
    """Return nodes and weights of Fejer's first rule on [-1, 1]. Gauss's rule needs linear algebra, which depends on the CPU."""
    angles = [(k + 0.5) * math.pi / PANEL_NODES for k in range(PANEL_NODES)]
    orders = range(1, PANEL_NODES // 2 + 1)
    sums = [math.fsum(math.cos(2 * j * angle) / (4 * j * j - 1) for j in orders) for angle in angles]
    return np.array([math.cos(angle) for angle in angles]), 2.0 / PANEL_NODES * (1.0 - 2.0 * np.array(sums))


@njit(cache=True)
def mittag_leffler(r: float, alpha: float, series: Floats, decay_value: Floats, decay_slope: Floats) -> float:
    """Return E_alpha(-r^alpha) for r >= 0, with an error below 1e-10 of its envelope.

    Args:
        r: lambda^(1/alpha) k, not negative.
        alpha: In (2, 3].
        series: Result of ``series_coefficients(alpha)``.
        decay_value: First table of ``decay_table(alpha)``.
        decay_slope: Second table of ``decay_table(alpha)``.
    """
    if r <= SERIES_LIMIT:
        z = r**alpha
        total = 0.0
        for j in range(SERIES_TERMS - 1, -1, -1):  # (3.11) by Horner
            total = total * z + series[j]
        return total
    angle = math.pi / alpha
    wave = 2.0 / alpha * math.exp(r * math.cos(angle)) * math.cos(r * math.sin(angle))
    return wave + _decay(r, decay_value, decay_slope)


@njit(cache=True)
def _decay(r: float, value: Floats, slope: Floats) -> float:
    """Return G_alpha(r) by cubic Hermite interpolation of its table over w = 1/(1 + r)."""
    step = _W_END / (TABLE_POINTS - 1)
    position = 1.0 / (1.0 + r) / step
    i = min(int(position), TABLE_POINTS - 2)
    t = position - i
    w = t * t * (3.0 - 2.0 * t)  # weight of the right node
    bend = t * (1.0 - t) * step
    return value[i] + w * (value[i + 1] - value[i]) + bend * ((1.0 - t) * slope[i] - t * slope[i + 1])
