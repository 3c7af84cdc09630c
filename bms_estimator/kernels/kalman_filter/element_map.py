"""Map of the identified elements over SOC, and fit of the thesis's functions (2.5)-(2.9) to the map.

The identifier estimates the elements at the present SOC. The map stores the information-weighted mean of these estimates
for each SOC bin. (2.5)-(2.9) are fitted to the map by a search over the nonlinear exponent and linear least squares for
amplitude and offset.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

BINS = 25
"""Number of bins of equal width over SOC 0..1."""
ELEMENT_NAMES = ("r_ts_ohm", "r_tl_ohm", "c_ts_farad", "c_tl_farad", "r_s_ohm")
"""Names of the elements in the order of their parameters: a1..a3, a4..a6, a7..a9, a10..a12, a13..a15."""
ELEMENTS = len(ELEMENT_NAMES)
"""Number of elements."""
CAPACITANCES = (2, 3)
"""Rows of C_ts and C_tl in the map."""
MAX_LN_VARIANCE = 0.5**2
"""Maximum variance of the logarithm of an estimate that is added to the map: a relative std of 50 %."""
MODEL_ERROR = 0.02
"""Assumed relative error with which (2.5)-(2.9) describe a real element."""
PRIOR_ERROR = 0.7
"""Relative error of the prior in SOC bins without data. The prior is the configured function, scaled to fit the bins with
data."""
EXPONENT_MIN = 0.5
"""Lower limit of the exponents. A function with a smaller exponent is nearly a straight line over SOC 0..1."""
EXPONENT_MAX = 300.0
"""Upper limit of the exponents. A function with a larger exponent decays within a small part of the first bin."""
SEARCH_POINTS = 24
"""Number of exponents in the logarithmic search."""
REFINEMENTS = 12
"""Number of golden section steps around the best point of the search."""
ALTERNATIONS = 12
"""Number of iterations that fit amplitude and offset alternately within their bounds."""
MIN_RATIO = 1e-3
"""Minimum of a fitted amplitude or offset, as a fraction of the mean of the data, because both must be positive."""
MIN_PRIOR_FRACTION = 0.05
"""Minimum of the configured function as a fraction of its offset, because a capacitance may be negative near empty."""

ELEMENT_MAP = np.dtype(
    [
        ("weight", "f8", (ELEMENTS, BINS)),  # sum of dt / variance [s]
        ("moment", "f8", (ELEMENTS, BINS)),  # sum of dt ln(value) / variance
        ("soc_moment", "f8", (ELEMENTS, BINS)),  # sum of dt soc / variance
        ("dwell_s", "f8", (ELEMENTS, BINS)),  # sum of dt
    ],
    align=True,
)
"""Information-weighted sums of the logarithm of each element, by SOC bin."""

ELEMENT_FIT = np.dtype(
    [
        ("a", "f8", PARAMETERS),  # a1..a15 at their own index
        ("std", "f8", PARAMETERS),  # standard errors, NaN without data
        ("delta_std", "f8", ELEMENTS),  # standard errors of ``delta``, (2.11) and (2.12); NaN without data
        ("bins", "i8", ELEMENTS),  # number of bins with data of the element
        ("soc", "f8", BINS),  # data of the last fit: SOC
        ("value", "f8", BINS),  # data of the last fit: element at ``soc``
        ("weight", "f8", BINS),  # data of the last fit: inverse variance of ``value``
    ],
    align=True,
)
"""Parameters of (2.5)-(2.9) fitted to the map."""


@njit(cache=True)
def add_observation(m: Record, element: int, soc: float, ln_value: float, variance: float, dt_s: float) -> bool:
    """Add an estimate of ln of one element, with its variance, to the bin of ``soc``.

    Returns:
        True if the variance was small enough for the map.
    """
    if not 0.0 < variance < MAX_LN_VARIANCE:
        return False
    b = min(max(int(soc * BINS), 0), BINS - 1)
    m.weight[element, b] += dt_s / variance
    m.moment[element, b] += ln_value * dt_s / variance
    m.soc_moment[element, b] += soc * dt_s / variance
    m.dwell_s[element, b] += dt_s
    return True


@njit(cache=True)
def decay_weights(m: Record, e: int, factor: float) -> None:
    """Multiply the weights of row ``e`` of the map by ``factor``."""
    for b in range(BINS):
        m.weight[e, b] *= factor
        m.moment[e, b] *= factor
        m.soc_moment[e, b] *= factor
        m.dwell_s[e, b] *= factor


@njit(cache=True)
def fit_element(m: Record, e: int, prior: Floats, fit: Record) -> None:
    """Fit the function of one element, one of (2.5)-(2.9), to its row of the map.

    Args:
        m: Record of ELEMENT_MAP.
        e: Row of the map, an index of ``ELEMENT_NAMES``.
        prior: Configured a1..a15 at index 1..15, a weak prior for empty bins.
        fit: Record of ELEMENT_FIT, written.
    """
    x, y, w = fit.soc, fit.value, fit.weight
    base = 3 * e + 1
    sign = _sign(e)
    fit.bins[e] = _observations(m, e, prior, base, sign, x, y, w)
    if fit.bins[e] == 0:
        for i in range(base, base + 3):
            fit.a[i] = prior[i]
            fit.std[i] = math.nan
        fit.delta_std[e] = math.nan
        return
    exponent = _best_exponent(prior[base + 1], sign, x, y, w)
    amplitude, offset, _ = _linear_part(exponent, sign, x, y, w)
    fit.a[base], fit.a[base + 1], fit.a[base + 2] = amplitude, exponent, offset
    fit.delta_std[e] = _standard_errors(fit, base, sign, x, w, _common_variance(m, e))


@njit(cache=True)
def fit_within(fit: Record, e: int, lower: Floats, upper: Floats) -> tuple[float, float, float]:
    """Return amplitude, exponent and offset of the element fitted last, within bounds.

    If a bound limits one of these values, the others are fitted again, because clipping each alone would give a poor fit.

    Args:
        fit: Record of ELEMENT_FIT after ``fit_element`` for this element.
        e: Row of the map, 0..4.
        lower: Lower bounds of a1..a15 at index 1..15.
        upper: Upper bounds of a1..a15 at index 1..15.
    """
    i = 3 * e + 1
    amplitude, exponent, offset = fit.a[i], fit.a[i + 1], fit.a[i + 2]
    if (
        lower[i] <= amplitude <= upper[i]
        and lower[i + 1] <= exponent <= upper[i + 1]
        and lower[i + 2] <= offset <= upper[i + 2]
    ):
        return amplitude, exponent, offset
    exponent = min(max(exponent, lower[i + 1]), upper[i + 1])
    sw, sg, sgg, sy, sgy, _ = _sums(exponent, _sign(e), fit.soc, fit.value, fit.weight)
    for _ in range(ALTERNATIONS):
        amplitude = min(max((sgy - sg * offset) / sgg, lower[i]), upper[i])
        offset = min(max((sy - sg * amplitude) / sw, lower[i + 2]), upper[i + 2])
    return amplitude, exponent, offset


@njit(cache=True)
def _sign(e: int) -> float:
    """Return the sign of the amplitude in (2.5)-(2.9): -1 for capacitances, which rise with SOC."""
    return -1.0 if e in CAPACITANCES else 1.0


@njit(cache=True)
def _observations(m: Record, e: int, prior: Floats, base: int, sign: float, x: Floats, y: Floats, w: Floats) -> int:
    """Write SOC, value and weight of the element in each bin to ``x``, ``y`` and ``w``; return the number of visited bins."""
    visited = 0
    ln_ratios = weights = 0.0
    for b in range(BINS):
        x[b] = (b + 0.5) / BINS
        if m.weight[e, b] > 0.0:
            x[b] = m.soc_moment[e, b] / m.weight[e, b]
        configured = prior[base + 2] + sign * prior[base] * math.exp(-prior[base + 1] * x[b])
        y[b] = max(configured, MIN_PRIOR_FRACTION * prior[base + 2])
        w[b] = 0.0
        if m.weight[e, b] > 0.0:
            visited += 1
            # samples of one pass are not independent: the weight uses the mean variance, not the variance of the mean
            w[b] = 1.0 / (m.dwell_s[e, b] / m.weight[e, b] + MODEL_ERROR**2)
            ln_ratios += w[b] * (m.moment[e, b] / m.weight[e, b] - math.log(y[b]))
            weights += w[b]
    # geometric mean of the measured value over the configured function in the visited bins
    scale = math.exp(ln_ratios / weights) if visited > 0 else 1.0
    for b in range(BINS):
        if m.weight[e, b] > 0.0:
            y[b] = math.exp(m.moment[e, b] / m.weight[e, b])
            w[b] /= y[b] * y[b]
        else:
            y[b] *= scale
            w[b] = 1.0 / (PRIOR_ERROR * y[b]) ** 2
    return visited


@njit(cache=True)
def _best_exponent(start: float, sign: float, x: Floats, y: Floats, w: Floats) -> float:
    """Return the exponent with the least cost, by a logarithmic search and a golden section around its best point.

    The search also tries the exponent ``start``.
    """
    ln_step = math.log(EXPONENT_MAX / EXPONENT_MIN) / (SEARCH_POINTS - 1)
    lowest, highest = math.log(EXPONENT_MIN), math.log(EXPONENT_MAX)
    # all of these are logarithms of exponents
    best = min(max(math.log(start), lowest), highest)
    least = _linear_part(math.exp(best), sign, x, y, w)[2]
    for j in range(SEARCH_POINTS):
        candidate = lowest + ln_step * j
        cost = _linear_part(math.exp(candidate), sign, x, y, w)[2]
        if cost < least:
            best, least = candidate, cost
    low, high = max(best - ln_step, lowest), min(best + ln_step, highest)
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    left, right = high - golden * (high - low), low + golden * (high - low)
    cost_left = _linear_part(math.exp(left), sign, x, y, w)[2]
    cost_right = _linear_part(math.exp(right), sign, x, y, w)[2]
    for _ in range(REFINEMENTS):
        if cost_left < cost_right:
            high, right, cost_right = right, left, cost_left
            left = high - golden * (high - low)
            cost_left = _linear_part(math.exp(left), sign, x, y, w)[2]
        else:
            low, left, cost_left = left, right, cost_right
            right = low + golden * (high - low)
            cost_right = _linear_part(math.exp(right), sign, x, y, w)[2]
    return math.exp(0.5 * (low + high))


@njit(cache=True)
def _sums(
    exponent: float, sign: float, x: Floats, y: Floats, w: Floats
) -> tuple[float, float, float, float, float, float]:
    """Return the weighted sums of 1, g, g g, y, g y, y y with g = sign e^(-exponent x)."""
    sw = sg = sgg = sy = sgy = syy = 0.0
    for b in range(BINS):
        g = sign * math.exp(-exponent * x[b])
        sw += w[b]
        sg += w[b] * g
        sgg += w[b] * g * g
        sy += w[b] * y[b]
        sgy += w[b] * g * y[b]
        syy += w[b] * y[b] * y[b]
    return sw, sg, sgg, sy, sgy, syy


@njit(cache=True)
def _linear_part(exponent: float, sign: float, x: Floats, y: Floats, w: Floats) -> tuple[float, float, float]:
    """Return positive amplitude and offset by weighted least squares for this exponent, and the cost."""
    sw, sg, sgg, sy, sgy, syy = _sums(exponent, sign, x, y, w)
    det = sw * sgg - sg * sg
    offset = sy / sw
    amplitude = MIN_RATIO * offset
    if det > 1e-12 * sw * sgg:  # not singular: g differs between the bins
        unconstrained = (sw * sgy - sg * sy) / det
        amplitude = max(amplitude, unconstrained)
    offset = max((sy - sg * amplitude) / sw, MIN_RATIO * offset)
    # weighted sum of (y - model)^2 with the model offset + amplitude g
    model_square = offset * sw * offset + amplitude * (2.0 * offset * sg + amplitude * sgg)
    cost = syy + model_square - 2.0 * (offset * sy + amplitude * sgy)
    return amplitude, offset, cost


@njit(cache=True)
def _common_variance(m: Record, e: int) -> float:
    """Return the relative variance of the factor that the errors of all bins have in common.

    The filter has one scale for a resistance at all SOCs, and the time constants of the RC pairs are constant. Therefore the
    errors of the bins are nearly equal, and more bins do not reduce them. The mean over the visited time estimates them.
    """
    dwell_s = weight = 0.0
    for b in range(BINS):
        dwell_s += m.dwell_s[e, b]
        weight += m.weight[e, b]
    return dwell_s / weight


@njit(cache=True)
def _standard_errors(fit: Record, base: int, sign: float, x: Floats, w: Floats, common: float) -> float:
    """Write the standard errors, and return that of ln(amplitude / offset) / exponent; NaN if the matrix J' W J is singular.

    The variances are the diagonal of (J' W J)^-1, computed by elimination, for independent errors of the bins. Amplitude and
    offset are proportional to the common factor of the bins, so that its relative variance ``common`` is added to theirs. It
    cancels out of their ratio.
    """
    amplitude, exponent, offset = fit.a[base], fit.a[base + 1], fit.a[base + 2]
    # a weak prior keeps the matrix regular: each parameter has a std of 3 times its value
    h00, h11, h22 = (3.0 * amplitude) ** -2, (3.0 * exponent) ** -2, (3.0 * offset) ** -2
    h01 = h02 = h12 = 0.0
    for b in range(BINS):
        by_amplitude = sign * math.exp(-exponent * x[b])
        by_exponent = -x[b] * amplitude * by_amplitude
        h00 += w[b] * by_amplitude * by_amplitude
        h01 += w[b] * by_amplitude * by_exponent
        h02 += w[b] * by_amplitude
        h11 += w[b] * by_exponent * by_exponent
        h12 += w[b] * by_exponent
        h22 += w[b]
    for i in range(base, base + 3):
        fit.std[i] = math.nan
    if not h00 > 0.0:
        return math.nan
    l10, l20 = h01 / h00, h02 / h00
    d1 = h11 - l10 * h01
    if not d1 > 0.0:
        return math.nan
    l21 = (h12 - l10 * h02) / d1
    d2 = h22 - l20 * h02 - l21 * l21 * d1
    if not d2 > 0.0:
        return math.nan
    amplitude_variance = 1.0 / h00 + l10 * l10 / d1 + (l10 * l21 - l20) ** 2 / d2
    fit.std[base] = math.sqrt(amplitude_variance + common * amplitude * amplitude)
    fit.std[base + 1] = math.sqrt(1.0 / d1 + l21 * l21 / d2)
    fit.std[base + 2] = math.sqrt(1.0 / d2 + common * offset * offset)
    # gradient of ln(amplitude / offset) / exponent, and the solution of L z = gradient with J' W J = L D L'
    z0 = 1.0 / (amplitude * exponent)
    z1 = -math.log(amplitude / offset) / (exponent * exponent) - l10 * z0
    z2 = -1.0 / (offset * exponent) - l20 * z0 - l21 * z1
    return math.sqrt(z0 * z0 / h00 + z1 * z1 / d1 + z2 * z2 / d2)
