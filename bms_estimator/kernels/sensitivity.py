"""Terminal voltage of the cell under a held current, and its derivatives by everything that is identified.

The derivatives go along with the states: d(x2, x3)/dtheta obeys the step of x2 and x3 differentiated (exact for
current held over the step), so that one pass over a capture gives the whole Jacobian, at any length of step.
Below SOC 0 the elements stay as they are at 0: their exponentials would run away.

Columns of a Jacobian, with m coefficients of the OCV correction: a1..a15, the m coefficients, SOC at the first sample,
a series resistance of the capture's own. Units as in ``kernels.cell``.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bms_estimator.kernels.cell import ocv_and_slope, rc_step

Floats = NDArray[np.float64]

LEAST_CAPACITANCE = 1e-3
"""C_ts, C_tl are held at this fraction of a9, a12 below delta1, delta2, where (2.7), (2.8) turn negative."""
ELEMENTS = 15
"""a1..a15."""


@njit(cache=True)
def spline_weights(soc: float, count: int, w: Floats) -> int:
    """Values and slopes of the four cubic B-splines (uniform knots on 0..1) that are not zero at ``soc``.

    Beyond 0..1 the spline goes on as a line.

    Args:
        soc: State of charge.
        count: Coefficients of the spline, at least 4.
        w: Shape (8,), overwritten: four values, then four slopes [1 per SOC].

    Returns:
        Index of the first of the four coefficients.
    """
    pieces = count - 3
    i = min(max(math.floor(soc * pieces), 0), pieces - 1)
    t = min(max(soc * pieces - i, 0.0), 1.0)
    beyond = soc * pieces - i - t
    u = 1.0 - t
    w[0] = u * u * u / 6.0
    w[1] = (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    w[2] = (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0
    w[3] = t * t * t / 6.0
    w[4] = -0.5 * u * u
    w[5] = 0.5 * (3.0 * t * t - 4.0 * t)
    w[6] = -0.5 * (3.0 * u * u - 4.0 * u)
    w[7] = 0.5 * t * t
    for k in range(4):
        w[k] += beyond * w[4 + k]
        w[4 + k] *= pieces
    return i


@njit(cache=True)
def _branch_step(d: Floats, v: float, x: Floats, b: int, middle: float, wanted: float, i: float, dt: float) -> float:
    """One RC branch over one step, with its derivatives.

    Args:
        d: Shape (7,), dv by (R's amplitude, exponent, offset, C's amplitude, exponent, offset, initial SOC); updated.
        v: Branch voltage before the step [V].
        x: a1..a15 at index 1..15.
        b: 0 for the short-term branch, 1 for the long-term one.
        middle: SOC at mid-step.
        wanted: 1 where the derivatives are wanted, else 0.
        i: Discharge current [A].
        dt: Step [s].

    Returns:
        Branch voltage after the step [V].
    """
    r0, c0 = 1 + 3 * b, 7 + 3 * b
    soc = max(middle, 0.0)
    er = math.exp(-x[r0 + 1] * soc)
    ec = math.exp(-x[c0 + 1] * soc)
    r = x[r0] * er + x[r0 + 2]  # (2.5), (2.6)
    c = -x[c0] * ec + x[c0 + 2]  # (2.7), (2.8)
    least = LEAST_CAPACITANCE * x[c0 + 2]
    held = c < least
    c = max(c, least)
    after, decay, by_r, by_tau = rc_step(v, i, r, r * c, dt)
    if wanted > 0.0:
        by_r += by_tau * c
        by_c = by_tau * r
        d_c = 0.0 if held else by_c
        by_soc = -by_r * x[r0] * x[r0 + 1] * er + d_c * x[c0] * x[c0 + 1] * ec
        d[0] = decay * d[0] + by_r * er
        d[1] = decay * d[1] - by_r * x[r0] * soc * er
        d[2] = decay * d[2] + by_r
        d[3] = decay * d[3] - d_c * ec
        d[4] = decay * d[4] + d_c * x[c0] * soc * ec
        d[5] = decay * d[5] + (by_c * LEAST_CAPACITANCE if held else d_c)
        d[6] = decay * d[6] + (by_soc if middle > 0.0 else 0.0)
    return after  # (2.2), (2.3)


@njit(cache=True)
def sensitivities(
    time_s: Floats,
    current_a: Floats,
    held_a: Floats,
    soc0: float,
    extra_ohm: float,
    capacity_as: float,
    x: Floats,
    ocv_v: Floats,
    ocv_slope_v: Floats,
    correction_v: Floats,
    voltage_v: Floats,
    jacobian: Floats,
) -> None:
    """Terminal voltage (2.4) at every sample, from rest, and its derivatives.

    Args:
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), at the sample, discharge positive [A].
        held_a: Shape (n,), mean from the sample to the next [A].
        soc0: SOC at the first sample.
        extra_ohm: Series resistance of this capture on top of R_s [ohm].
        capacity_as: Capacity C_c [A s].
        x: a1..a15 at index 1..15.
        ocv_v: Open-circuit voltage on the grid of ``kernels.cell.ocv_and_slope`` [V].
        ocv_slope_v: Its slope on the same grid [V].
        correction_v: Shape (m,), coefficients of the B-spline added to it [V].
        voltage_v: Shape (n,), overwritten [V].
        jacobian: Shape (n, 15 + m + 2), overwritten; shape (0, 0): no derivatives.
    """
    m = correction_v.shape[0]
    wanted = 1.0 if jacobian.shape[0] > 0 else 0.0
    w = np.zeros(8)
    d_ts = np.zeros(7)
    d_tl = np.zeros(7)
    soc, v_ts, v_tl = soc0, 0.0, 0.0
    for j in range(time_s.shape[0]):
        if j > 0:
            dt, i = time_s[j] - time_s[j - 1], held_a[j - 1]
            drop = i * dt / capacity_as
            v_ts = _branch_step(d_ts, v_ts, x, 0, soc - 0.5 * drop, wanted, i, dt)
            v_tl = _branch_step(d_tl, v_tl, x, 1, soc - 0.5 * drop, wanted, i, dt)
            soc -= drop  # (2.1)
        i = current_a[j]
        first = spline_weights(soc, m, w)
        added = 0.0
        for k in range(4):
            added += w[k] * correction_v[first + k]
        es = math.exp(-x[14] * max(soc, 0.0))
        r_s = x[13] * es + x[15] + extra_ohm  # (2.9)
        e_o, slope = ocv_and_slope(soc, ocv_v, ocv_slope_v)
        voltage_v[j] = e_o + added - v_ts - v_tl - i * r_s  # (2.4)
        if wanted > 0.0:
            row = jacobian[j]
            row[:] = 0.0
            for k in range(3):
                row[k] = -d_ts[k]
                row[3 + k] = -d_tl[k]
                row[6 + k] = -d_ts[3 + k]
                row[9 + k] = -d_tl[3 + k]
            row[12] = -i * es
            row[13] = i * x[13] * max(soc, 0.0) * es
            row[14] = -i
            for k in range(4):
                row[ELEMENTS + first + k] = w[k]
                slope += w[4 + k] * correction_v[first + k]
            row[ELEMENTS + m] = slope + (i * x[13] * x[14] * es if soc > 0.0 else 0.0) - d_ts[6] - d_tl[6]
            row[ELEMENTS + m + 1] = -i


@njit(cache=True)
def whiten(rows: Floats, time_s: Floats, white_v: float, drift_v: float, tau_s: float) -> None:
    """Rows of errors (or of their derivatives) to one-step prediction errors of unit variance, in place.

    The error is white noise plus a first-order Gauss-Markov process; its Kalman predictor has gains that do not
    depend on the data, so that errors and derivatives pass the same linear filter.

    Args:
        rows: Shape (n, k), one column for each signal [V].
        time_s: Shape (n,), increasing [s].
        white_v: Standard deviation of the white part [V].
        drift_v: Standard deviation of the Gauss-Markov part [V].
        tau_s: Its correlation time [s].
    """
    k = rows.shape[1]
    state = np.zeros(k)
    variance = drift_v * drift_v
    for j in range(rows.shape[0]):
        if j > 0:
            keep = math.exp(-(time_s[j] - time_s[j - 1]) / tau_s)
            variance = keep * keep * variance + drift_v * drift_v * (1.0 - keep * keep)
            for q in range(k):
                state[q] *= keep
        total = variance + white_v * white_v
        gain = variance / total
        scale = 1.0 / math.sqrt(total)
        for q in range(k):
            innovation = rows[j, q] - state[q]
            state[q] += gain * innovation
            rows[j, q] = innovation * scale
        variance *= 1.0 - gain
