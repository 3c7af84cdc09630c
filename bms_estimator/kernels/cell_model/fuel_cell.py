"""Fuel cell model of section 7.3 of the thesis: Nernst voltage with Tafel, ohmic and concentration losses, and a double layer.

A stack of n cells is modeled as one element. Its current i is positive when the stack delivers power::

    y = E - v - r i
    E = n (1.229 - 8.5e-4 (T - 298.15) + 4.3085e-5 T (ln p_H2 + 1/2 ln p_O2))    Nernst, Mann et al. (2000)
    C dv/dt = I - I e^((v - v_inf(I)) / A),   I = i + i_n                        double layer, Tafel's kinetics
    v_inf(I) = a + A ln I - B ln(1 - I / i_L)                                    Larminie and Dicks (2003), 3.4 to 3.7

T is in K, pressures are in atm, I is in A. a is the loss at 1 A, and the exchange current is e^(-a / A) A. v is the
activation and concentration overpotential of the whole stack. The file gives r, A and a at one temperature, and
``load_file_constants`` converts them to the stack's temperature. At constant current over a sample, e^(-v / A) is a
first-order lag with the time constant A C / I, so that a step of any length is exact.

Correa et al. use v / v_inf(I) in place of the exponential. Both models converge to v_inf. Theirs is v_inf / A (6 to 9)
times slower with the same C, because it replaces the slope of Tafel's curve by its chord. Impedance measures the slope,
A / I.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import interpolated_current
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit

NAMES = (
    "r_ohm",
    "tafel_slope_v",
    "activation_v",
    "c_dl_farad",
    "concentration_v",
    "limiting_current_a",
    "internal_current_a",
)
"""Names of the identified parameters r, A, a, C, B, i_L, i_n. theta is the logarithm of each value over the file's value."""

R, TAFEL, ACTIVATION, C_DL, B, LIMIT, INTERNAL = range(len(NAMES))
"""Indices of the parameters in theta and ``constants``."""
E = len(NAMES)
"""Index of E in ``constants``."""
CELLS, TEMPERATURE, HYDROGEN, OXYGEN = range(1 + len(NAMES), 5 + len(NAMES))
"""Indices into the constants of a file, shape (16,), after the parameters at 1..7: cells in series, temperature of the
file's parameters [C], partial pressures [atm]."""
BARRIER_V = 0.948
"""Activation energy of the cathode reaction per transferred charge, of one cell [V]: xi_1 of Mann et al. (2000). With an
Arrhenius dependence of the exchange current, it is the parameter a at 0 K."""
MEMBRANE_K = 1268.0
"""Temperature coefficient of the membrane's conductivity, e^(-1268 / T), by Springer et al. (1991) [K]."""
MIN_REMAINDER = 0.02
"""Lower limit of 1 - I / i_L. Above 98 % of the limiting current the loss is constant, because no steady state exists."""


@njit(cache=True)
def nernst(temperature_k: float, hydrogen_atm: float, oxygen_atm: float) -> float:
    """Return the reversible voltage of one cell [V].

    Args:
        temperature_k: Temperature of the cell [K].
        hydrogen_atm: Partial pressure at the anode [atm].
        oxygen_atm: Partial pressure at the cathode [atm].
    """
    entropy_v = 8.5e-4 * (temperature_k - 298.15)
    return 1.229 - entropy_v + 4.3085e-5 * temperature_k * (math.log(hydrogen_atm) + 0.5 * math.log(oxygen_atm))


@njit(cache=True)
def load_constants(constants: Floats, p: Record, soc: float, temperature_c: float) -> None:  # noqa: ARG001 - shared signature
    """Write the parameters and E at ``temperature_c`` [C] to ``constants``; ``p`` is a record of ESTIMATOR_SETTINGS."""
    load_file_constants(constants, p.learning.file, temperature_c)


@njit(cache=True)
def load_file_constants(constants: Floats, file: Floats, temperature_c: float) -> None:
    """Write the parameters and E at ``temperature_c`` [C] to ``constants``.

    Args:
        constants: Shape (8,), written.
        file: Constants of the file, shape (16,).
        temperature_c: Temperature of the stack [C]; NaN: the file's temperature.
    """
    for j in range(len(NAMES)):
        constants[j] = file[1 + j]
    file_k = 273.15 + file[TEMPERATURE]
    kelvin = file_k if math.isnan(temperature_c) else 273.15 + temperature_c
    ratio = kelvin / file_k
    constants[R] *= math.exp(MEMBRANE_K * (1.0 / kelvin - 1.0 / file_k))
    constants[TAFEL] *= ratio  # R T / (alpha F)
    constants[ACTIVATION] = constants[ACTIVATION] * ratio + file[CELLS] * BARRIER_V * (1.0 - ratio)
    constants[E] = file[CELLS] * nernst(kelvin, file[HYDROGEN], file[OXYGEN])


@njit(cache=True)
def reaction_current(current_a: float, internal_a: float) -> float:
    """Return the reaction current I = i + i_n [A]. A negative i counts as 0, because a stack cannot be charged."""
    return max(current_a, 0.0) + internal_a


@njit(cache=True)
def steady_overpotential(theta: Floats, constants: Floats, current_a: float, slope: Floats) -> float:
    """Return v_inf(I) [V]; write its derivatives by theta to ``slope``, shape (8,)."""
    tafel_v, activation_v = (
        constants[TAFEL] * math.exp(theta[TAFEL]),
        constants[ACTIVATION] * math.exp(theta[ACTIVATION]),
    )
    b_v, limit_a = constants[B] * math.exp(theta[B]), constants[LIMIT] * math.exp(theta[LIMIT])
    internal_a = constants[INTERNAL] * math.exp(theta[INTERNAL])
    reaction_a = reaction_current(current_a, internal_a)
    remainder = 1.0 - reaction_a / limit_a
    is_limited = remainder < MIN_REMAINDER
    remainder = max(remainder, MIN_REMAINDER)
    concentration_slope = (
        0.0 if is_limited else b_v * reaction_a / (limit_a * remainder)
    )  # derivative of the loss by ln I
    slope[:] = 0.0
    slope[TAFEL] = tafel_v * math.log(reaction_a)
    slope[ACTIVATION] = activation_v
    slope[B] = -b_v * math.log(remainder)
    slope[LIMIT] = -concentration_slope
    slope[INTERNAL] = (tafel_v + concentration_slope) * internal_a / reaction_a
    return activation_v + slope[TAFEL] + slope[B]


@njit(cache=True)
def advance(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, dt_s: float) -> None:
    """Advance the overpotential and its sensitivities by ``dt_s`` under a constant current, exactly.

    Args:
        x: States [V], shape (2,); only the first, v, is used. Updated.
        dx: d x / d theta, shape (2, 8). Updated.
        theta: Logarithm of each parameter relative to the file's value, shape (8,).
        constants: The file's parameters, then E [V], shape (8,).
        current_a: Current over the step [A], positive when the stack delivers power.
        dt_s: Step [s].
    """
    slope = dx[1]  # scratch space: the row of the unused second state
    v_inf = steady_overpotential(theta, constants, current_a, slope)
    tafel_v, farad = constants[TAFEL] * math.exp(theta[TAFEL]), constants[C_DL] * math.exp(theta[C_DL])
    internal_a = constants[INTERNAL] * math.exp(theta[INTERNAL])
    reaction_a = reaction_current(current_a, internal_a)
    taus = dt_s * reaction_a / (tafel_v * farad)  # step in multiples of the time constant A C / I
    decay = math.exp(-taus)
    z = (v_inf - x[0]) / tafel_v
    lag = math.expm1(z) * decay
    log_lag = math.log1p(lag)
    by_start = math.exp(z) * decay / (1.0 + lag)  # d v / d v at the start of the step
    by_end = 1.0 - by_start  # d v / d v_inf
    by_ln_tau = tafel_v * taus * lag / (1.0 + lag)  # -d v / d ln of the time constant
    for j in range(len(NAMES)):
        dx[0, j] = by_start * dx[0, j] + by_end * slope[j]
    dx[0, TAFEL] += tafel_v * (by_start * z - log_lag) - by_ln_tau
    dx[0, C_DL] -= by_ln_tau
    dx[0, INTERNAL] += by_ln_tau * internal_a / reaction_a
    x[0] = v_inf - tafel_v * log_lag
    slope[:] = 0.0


@njit(cache=True)
def output(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, psi: Floats) -> float:
    """Return the terminal voltage y [V]; write its derivatives by theta to ``psi``, shape (8,).

    The other arguments are those of ``advance``. ``psi`` is 0 for a charging current above i_n, because such a current is
    a measurement error and gives no information on parameters.
    """
    drop_v = constants[R] * math.exp(theta[R]) * current_a
    for j in range(psi.shape[0]):
        psi[j] = -dx[0, j]
    psi[R] -= drop_v
    if current_a + constants[INTERNAL] * math.exp(theta[INTERNAL]) < 0.0:
        psi[:] = 0.0
    return constants[E] - x[0] - drop_v


@njit(cache=True)
def steady_state(x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float) -> None:
    """Set the state and its sensitivities to the steady state under ``current_a``. Arguments are those of ``advance``."""
    dx[1] = 0.0
    x[0], x[1] = steady_overpotential(theta, constants, current_a, dx[0]), 0.0


@njit(cache=True)
def write(theta: Floats, file: Floats, a: Floats) -> None:
    """Write the parameters at theta to ``a[1:8]`` in the order of ``NAMES``, and the file's constants to ``a[8:]``."""
    for j in range(len(NAMES)):
        a[1 + j] = file[1 + j] * math.exp(theta[j])
    for i in range(1 + len(NAMES), a.shape[0]):
        a[i] = file[i]


@njit(cache=True)
def open_loop(
    file: Floats, theta: Floats, time_s: Floats, current_a: Floats, temperature_c: Floats
) -> tuple[Floats, Floats]:
    """Simulate the voltage at each sample, from the steady state under the first current.

    Args:
        file: Constants of the file, shape (16,).
        theta: Logarithm of each parameter relative to the file's value, shape (8,).
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), positive when the stack delivers power [A].
        temperature_c: Shape (n,), NaN without a sensor [C].

    Returns:
        Voltage [V], shape (n,), and its derivatives by theta, shape (n, 8).
    """
    n = time_s.size
    voltage_v, psi = np.empty(n), np.zeros((n, theta.size))
    x, dx, constants = np.zeros(2), np.zeros((2, theta.size)), np.zeros(theta.size)
    for j in range(n):
        load_file_constants(constants, file, temperature_c[j])
        if j == 0:
            steady_state(x, dx, theta, constants, current_a[0])
        else:
            dt_s = time_s[j] - time_s[j - 1]
            advance(x, dx, theta, constants, interpolated_current(dt_s, current_a[j - 1], current_a[j]), dt_s)
        voltage_v[j] = output(x, dx, theta, constants, current_a[j], psi[j])
    return voltage_v, psi


@njit(cache=True)
def polarisation(file: Floats, theta: Floats, current_a: Floats, temperature_c: Floats) -> tuple[Floats, Floats]:
    """Return the steady-state voltage under each current [V], and its derivatives by theta.

    The arguments are those of ``open_loop``.
    """
    n = current_a.size
    voltage_v, psi = np.empty(n), np.zeros((n, theta.size))
    x, dx, constants = np.zeros(2), np.zeros((2, theta.size)), np.zeros(theta.size)
    for j in range(n):
        load_file_constants(constants, file, temperature_c[j])
        steady_state(x, dx, theta, constants, current_a[j])
        voltage_v[j] = output(x, dx, theta, constants, current_a[j], psi[j])
    return voltage_v, psi
