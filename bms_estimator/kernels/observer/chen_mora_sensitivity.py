"""The cell of Chen and Mora as a model that is learned: output, sensitivities, what its file gives.

theta is the logarithm of an element relative to the cell file's at the present SOC, so the shape over SOC stays that
of the file. ``x`` holds v_ts and v_tl of (2.2), (2.3) [V], and ``dx`` their derivatives by theta.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, ocv, r_s, r_tl, r_ts
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

NAMES = ("r_s", "r_ts", "tau_ts", "r_tl", "tau_tl")
"""Identified elements, in the order of theta."""
E_O = 5
"""Index of E_o [V] in ``given``; before it are the file's elements in the order of ``NAMES`` [ohm, s]."""


@njit(cache=True)
def load_constants(given: Floats, p: Record, soc: float, temperature_c: float) -> None:  # noqa: ARG001 - a fuel cell's needs it
    """E_o and the cell file's elements at ``soc`` into ``given``; ``p`` is a record of ESTIMATOR_SETTINGS.

    Elements are those of ``p.learning.soc_floor`` below it: there a capacitance may be negative (E14).
    """
    a, held = p.learning.file, max(soc, p.learning.soc_floor)
    given[0] = r_s(held, a)
    given[1] = r_ts(held, a)
    given[2] = given[1] * c_ts(held, a)
    given[3] = r_tl(held, a)
    given[4] = given[3] * c_tl(held, a)
    given[E_O] = ocv(soc, p.observer.ocv_v, p.observer.ocv_slope_v)


@njit(cache=True)
def steady_state(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float) -> None:  # noqa: ARG001
    """Set the states of a cell at rest: the branches are at zero."""
    x[:] = 0.0
    dx[:] = 0.0


@njit(cache=True)
def advance(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float, dt_s: float) -> None:
    """Both branches and their derivatives after ``dt_s`` under a held current: x' = (i R - x) / tau, (2.2)-(2.3), exactly."""
    for branch in range(2):
        r, tau = 1 + 2 * branch, 2 + 2 * branch
        settled_v = current_a * given[r] * math.exp(theta[r])
        lag = dt_s / (given[tau] * math.exp(theta[tau]))
        decay = math.exp(-lag)
        dx[branch, r] = settled_v + (dx[branch, r] - settled_v) * decay
        dx[branch, tau] = (dx[branch, tau] + lag * (x[branch] - settled_v)) * decay
        x[branch] = settled_v + (x[branch] - settled_v) * decay


@njit(cache=True)
def output(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float, psi: Floats) -> float:
    """Terminal voltage y^ (2.4) [V], and psi = dy^/dtheta into ``psi``."""
    ohmic_v = current_a * given[0] * math.exp(theta[0])
    psi[0] = -ohmic_v
    for branch in range(2):
        r, tau = 1 + 2 * branch, 2 + 2 * branch
        psi[r], psi[tau] = -dx[branch, r], -dx[branch, tau]
    return given[E_O] - x[0] - x[1] - ohmic_v  # (2.4)


@njit(cache=True)
def write(theta: Floats, file: Floats, a: Floats) -> None:
    """a1..a15 for theta: amplitude and offset of an element scale with it, exponents stay."""
    scale(file, a, 1, theta[1])
    scale(file, a, 4, theta[3])
    scale(file, a, 7, theta[2] - theta[1])
    scale(file, a, 10, theta[4] - theta[3])
    scale(file, a, 13, theta[0])


@njit(cache=True)
def scale(file: Floats, a: Floats, i: int, ln_ratio: float) -> None:
    """Scale the element of parameters a_i, a_i+1, a_i+2 by e^``ln_ratio`` over the file's."""
    ratio = math.exp(ln_ratio)
    a[i], a[i + 1], a[i + 2] = file[i] * ratio, file[i + 1], file[i + 2] * ratio
