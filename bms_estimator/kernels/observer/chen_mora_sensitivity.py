"""Chen and Mora's cell model for the learning law: output, sensitivities, and constants of the cell file.

Numbers in parentheses are equations of the thesis. Errata are listed in docs/theory/thesis.md.

theta is the logarithm of an element relative to the cell file's at the present SOC, so that the shape over SOC remains
that of the file. ``x`` contains v_ts and v_tl of (2.2), (2.3) [V], and ``dx`` their derivatives by theta.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, ocv, r_s, r_tl, r_ts
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

NAMES = ("r_s", "r_ts", "tau_ts", "r_tl", "tau_tl")
"""Identified elements, in the order of theta."""
E_O = len(NAMES)
"""Index of E_o [V] in ``constants``, after the file's elements in the order of ``NAMES`` [ohm, s]."""


@njit(cache=True)
def load_constants(constants: Floats, p: Record, soc: float, temperature_c: float) -> None:  # noqa: ARG001 - shared signature
    """Write the cell file's elements and E_o at ``soc`` to ``constants``; ``p`` is a record of ESTIMATOR_SETTINGS.

    Below ``p.learning.soc_floor`` the elements are those at the floor, because a capacitance may be negative there
    (erratum 14).
    """
    a, limited_soc = p.learning.file, max(soc, p.learning.soc_floor)
    constants[0] = r_s(limited_soc, a)
    constants[1] = r_ts(limited_soc, a)
    constants[2] = constants[1] * c_ts(limited_soc, a)
    constants[3] = r_tl(limited_soc, a)
    constants[4] = constants[3] * c_tl(limited_soc, a)
    constants[E_O] = ocv(soc, p.observer.ocv_v, p.observer.ocv_slope_v)


@njit(cache=True)
def steady_state(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float) -> None:  # noqa: ARG001
    """Set the states to those of a cell at rest: the RC voltages are zero."""
    x[:] = 0.0
    dx[:] = 0.0


@njit(cache=True)
def advance(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, dt_s: float) -> None:
    """Advance both RC voltages and their derivatives by ``dt_s`` under a constant current, exactly.

    The equation is x' = (i R - x) / tau, (2.2)-(2.3).
    """
    for branch in range(2):
        r, tau = 1 + 2 * branch, 2 + 2 * branch
        steady_v = current_a * constants[r] * math.exp(theta[r])
        lag = dt_s / (constants[tau] * math.exp(theta[tau]))
        decay = math.exp(-lag)
        dx[branch, r] = steady_v + (dx[branch, r] - steady_v) * decay
        dx[branch, tau] = (dx[branch, tau] + lag * (x[branch] - steady_v)) * decay
        x[branch] = steady_v + (x[branch] - steady_v) * decay


@njit(cache=True)
def output(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, psi: Floats) -> float:
    """Return the terminal voltage y^ (2.4) [V]; write dy^/dtheta to ``psi``."""
    ohmic_v = current_a * constants[0] * math.exp(theta[0])
    psi[0] = -ohmic_v
    for branch in range(2):
        r, tau = 1 + 2 * branch, 2 + 2 * branch
        psi[r], psi[tau] = -dx[branch, r], -dx[branch, tau]
    return constants[E_O] - x[0] - x[1] - ohmic_v  # (2.4)


@njit(cache=True)
def write(theta: Floats, file: Floats, a: Floats) -> None:
    """Write a1..a15 for theta. Amplitude and offset of an element scale with the element; exponents do not change."""
    scale(file, a, 1, theta[1])
    scale(file, a, 4, theta[3])
    scale(file, a, 7, theta[2] - theta[1])
    scale(file, a, 10, theta[4] - theta[3])
    scale(file, a, 13, theta[0])


@njit(cache=True)
def scale(file: Floats, a: Floats, i: int, ln_ratio: float) -> None:
    """Write the file's element with parameters a_i, a_i+1, a_i+2, scaled by e^``ln_ratio``."""
    ratio = math.exp(ln_ratio)
    a[i], a[i + 1], a[i + 2] = file[i] * ratio, file[i + 1], file[i + 2] * ratio
