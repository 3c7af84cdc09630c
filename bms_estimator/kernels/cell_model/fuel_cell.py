"""The fuel cell of section 7.3: Nernst, Tafel, ohmic and concentration losses over a double layer.

A stack of n cells as one two-terminal object under the current i, positive when it delivers::

    y = E - v - r i
    E = n (1.229 - 8.5e-4 (T - 298.15) + 4.3085e-5 T (ln p_H2 + 1/2 ln p_O2))    Nernst, Mann et al. (2000)
    C dv/dt = I - I e^((v - v_inf(I)) / A),   I = i + i_n                        double layer, Tafel's kinetics
    v_inf(I) = a + A ln I - B ln(1 - I / i_L)                                    Larminie and Dicks (2003), 3.4 to 3.7

T in K, pressures in atm, I in A: a is the loss at 1 A, and e^(-a / A) A the exchange current. v is the activation and
concentration overpotential of the whole stack. r, A and a are of the file's temperature and follow the stack's (``load_file_constants``).
At constant current over a sample, e^(-v / A) is a first-order lag with the time constant A C / I: the step is exact
for any length.

Correa et al. take v / v_inf(I) in place of the exponential. Both end at v_inf; theirs does so v_inf / A (6 to 9) times more
slowly from the same C, because it takes the chord of Tafel's curve for its slope. A / I is what impedance measures.
"""

import math

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
"""Identified parameters, as ln of the value over that of the file: r, A, a, C, B, i_L, i_n."""

R, TAFEL, ACTIVATION, C_DL, B, LIMIT, INTERNAL = range(len(NAMES))
E = len(NAMES)
"""Places in ``given``: those of the parameters, then E."""
CELLS, TEMPERATURE, HYDROGEN, OXYGEN = range(1 + len(NAMES), 5 + len(NAMES))
"""Indices into the constants, shape (16,): the file's parameters from 1 on, then cells in series, temperature without
a sensor [C], partial pressures [atm]."""
BARRIER_V = 0.948
"""Energy that the reaction at the cathode must be given, over its transferred charge: a at 0 K, of one cell, as A ln i_0
with i_0 after Arrhenius has it: xi_1 of Mann et al. (2000) [V]."""
MEMBRANE_K = 1268.0
"""Temperature coefficient of the membrane's conductivity, e^(-1268 / T): Springer et al. (1991) [K]."""
MIN_REST = 0.02
"""1 - I / i_L is no less: beyond 98 % of the limiting current the loss stays, for there is no steady state [1]."""


@njit(cache=True)
def nernst(temperature_k: float, hydrogen_atm: float, oxygen_atm: float) -> float:
    """Reversible voltage of one cell [V].

    Args:
        temperature_k: Temperature of the cell [K].
        hydrogen_atm: Partial pressure at the anode [atm].
        oxygen_atm: Partial pressure at the cathode [atm].
    """
    entropy_v = 8.5e-4 * (temperature_k - 298.15)
    return 1.229 - entropy_v + 4.3085e-5 * temperature_k * (math.log(hydrogen_atm) + 0.5 * math.log(oxygen_atm))


@njit(cache=True)
def load_constants(given: Floats, p: Record, soc: float, temperature_c: float) -> None:  # noqa: ARG001 - a cell's needs the SOC
    """Load the file's parameters, and E at ``temperature_c`` [C], into ``given``; ``p`` is a record of ESTIMATOR_SETTINGS."""
    load_file_constants(given, p.learning.file, temperature_c)


@njit(cache=True)
def load_file_constants(given: Floats, file: Floats, temperature_c: float) -> None:
    """Load the constants of the file, shape (16,), as ``load_constants`` does; without a temperature (NaN) at the file's."""
    for j in range(len(NAMES)):
        given[j] = file[1 + j]
    of_file = 273.15 + file[TEMPERATURE]
    kelvin = of_file if math.isnan(temperature_c) else 273.15 + temperature_c
    warmer = kelvin / of_file
    given[R] *= math.exp(MEMBRANE_K * (1.0 / kelvin - 1.0 / of_file))
    given[TAFEL] *= warmer  # R T / (alpha F)
    given[ACTIVATION] = given[ACTIVATION] * warmer + file[CELLS] * BARRIER_V * (1.0 - warmer)
    given[E] = file[CELLS] * nernst(kelvin, file[HYDROGEN], file[OXYGEN])


@njit(cache=True)
def reaction_current(current_a: float, internal_a: float) -> float:
    """I = i + i_n, what the electrodes turn over [A]; a stack takes no charge, so a negative i counts as none."""
    return max(current_a, 0.0) + internal_a


@njit(cache=True)
def settled(theta: Floats, given: Floats, current_a: float, slope: Floats) -> float:
    """v_inf(I) [V], and in ``slope`` its derivatives by theta, shape (8,)."""
    tafel_v, activation_v = given[TAFEL] * math.exp(theta[TAFEL]), given[ACTIVATION] * math.exp(theta[ACTIVATION])
    b_v, limit_a = given[B] * math.exp(theta[B]), given[LIMIT] * math.exp(theta[LIMIT])
    internal_a = given[INTERNAL] * math.exp(theta[INTERNAL])
    reaction_a = reaction_current(current_a, internal_a)
    rest = 1.0 - reaction_a / limit_a
    limited = rest < MIN_REST
    rest = max(rest, MIN_REST)
    gain = 0.0 if limited else b_v * reaction_a / (limit_a * rest)  # d v_inf / d ln I of the last term
    slope[:] = 0.0
    slope[TAFEL] = tafel_v * math.log(reaction_a)
    slope[ACTIVATION] = activation_v
    slope[B] = -b_v * math.log(rest)
    slope[LIMIT] = -gain
    slope[INTERNAL] = (tafel_v + gain) * internal_a / reaction_a
    return activation_v + slope[TAFEL] + slope[B]


@njit(cache=True)
def advance(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float, dt_s: float) -> None:
    """Advance the overpotential and its sensitivities by ``dt_s`` under a held current, exactly.

    Args:
        x: States [V], shape (2,): v; the second is not used. Updated.
        dx: d x / d theta, shape (2, 8). Updated.
        theta: ln of each parameter over the file's, shape (8,).
        given: The file's parameters, then E [V], shape (8,).
        current_a: Held [A], positive when the stack delivers.
        dt_s: Step [s].
    """
    slope = dx[1]  # the second state has none: its row holds those of v_inf for the while
    v_inf = settled(theta, given, current_a, slope)
    tafel_v, farad = given[TAFEL] * math.exp(theta[TAFEL]), given[C_DL] * math.exp(theta[C_DL])
    internal_a = given[INTERNAL] * math.exp(theta[INTERNAL])
    reaction_a = reaction_current(current_a, internal_a)
    steps = dt_s * reaction_a / (tafel_v * farad)  # in time constants A C / I
    decay = math.exp(-steps)
    z = (v_inf - x[0]) / tafel_v
    behind = math.expm1(z) * decay
    log_behind = math.log1p(behind)
    along = math.exp(z) * decay / (1.0 + behind)  # d v / d v before
    ahead = 1.0 - along  # d v / d v_inf
    fade = tafel_v * steps * behind / (1.0 + behind)  # d v / d ln of the time constant, negative
    for j in range(len(NAMES)):
        dx[0, j] = along * dx[0, j] + ahead * slope[j]
    dx[0, TAFEL] += tafel_v * (along * z - log_behind) - fade
    dx[0, C_DL] -= fade
    dx[0, INTERNAL] += fade * internal_a / reaction_a
    x[0] = v_inf - tafel_v * log_behind
    slope[:] = 0.0


@njit(cache=True)
def output(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float, psi: Floats) -> float:
    """Terminal voltage y [V] at ``current_a``, and in ``psi`` its derivatives by theta, shape (8,); rest as ``advance``.

    If more than i_n flows in, ``psi`` is 0: that current is wrong and gives no information on parameters.
    """
    drop_v = given[R] * math.exp(theta[R]) * current_a
    for j in range(psi.shape[0]):
        psi[j] = -dx[0, j]
    psi[R] -= drop_v
    if current_a + given[INTERNAL] * math.exp(theta[INTERNAL]) < 0.0:
        psi[:] = 0.0
    return given[E] - x[0] - drop_v


@njit(cache=True)
def steady_state(x: Floats, dx: Floats, theta: Floats, given: Floats, current_a: float) -> None:
    """Set the state and its sensitivities to their steady values under ``current_a``; arguments as in ``advance``."""
    dx[1] = 0.0
    x[0], x[1] = settled(theta, given, current_a, dx[0]), 0.0


@njit(cache=True)
def write(theta: Floats, file: Floats, a: Floats) -> None:
    """Write the parameters of theta to ``a[1]`` and later, in the order of ``NAMES``.

    The rest is that of the file.
    """
    for j in range(len(NAMES)):
        a[1 + j] = file[1 + j] * math.exp(theta[j])
    for i in range(1 + len(NAMES), a.shape[0]):
        a[i] = file[i]
