"""Learning law: least squares with discounting over sensitivities, for each model of ``Model``.

The modules ``chen_mora_sensitivity`` and ``fuel_cell`` define the functions of a model. An integer selects the model, because
numba's disk cache cannot store first-class functions.

(3.13) is an equation of the thesis, and erratum 2 is described in docs/theory/thesis.md.

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS. ``m`` and ``q`` are their fields ``learning``, ``o`` is
the field ``observer`` of ``s``.
"""

import math
from enum import IntEnum

from bms_estimator.kernels.cell_model import fuel_cell
from bms_estimator.kernels.cell_model.current_interpolation import interpolated_current
from bms_estimator.kernels.observer import chen_mora_sensitivity
from bms_estimator.kernels.observer.observer import lock_transition, update_margins
from bms_estimator.model.arrays import Floats, Record
from bms_estimator.numba_cache import njit


class Model(IntEnum):
    """Model that is identified."""

    CHEN_MORA = 0
    FUEL_CELL = 1


_CHEN_MORA = int(Model.CHEN_MORA)
_FUEL_CELL = int(Model.FUEL_CELL)
NAMES = {Model.CHEN_MORA: chen_mora_sensitivity.NAMES, Model.FUEL_CELL: fuel_cell.NAMES}
"""Identified parameters of each model, in the order of theta."""
LEARN_EVERY_S = 0.999
"""Minimum interval between two steps of theta [s]. Samples between them only add information."""
MAX_RATE_HZ = 0.1
"""Maximum of gamma k [1/s]. The state k never decreases, and a theta that is faster than some 10 s follows noise."""
RESTING_C = 0.02
"""Maximum current at which the first sample counts as one of a cell at rest, as a C-rate."""


@njit(cache=True)
def load_constants(model: int, constants: Floats, p: Record, soc: float, temperature_c: float) -> None:
    """Load the model's constants for this sample; ``p`` is a record of ESTIMATOR_SETTINGS."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.load_constants(constants, p, soc, temperature_c)
    elif model == _FUEL_CELL:
        fuel_cell.load_constants(constants, p, soc, temperature_c)


@njit(cache=True)
def steady_state(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float) -> None:
    """Set states and derivatives in place to the steady state, for a sample with unknown history."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.steady_state(x, dx, theta, constants, current_a)
    elif model == _FUEL_CELL:
        fuel_cell.steady_state(x, dx, theta, constants, current_a)


@njit(cache=True)
def advance(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, dt_s: float) -> None:
    """Advance states ``x`` (2,) [V] and derivatives ``dx`` (2, 8) in place by ``dt_s`` under a constant current."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.advance(x, dx, theta, constants, current_a, dt_s)
    elif model == _FUEL_CELL:
        fuel_cell.advance(x, dx, theta, constants, current_a, dt_s)


@njit(cache=True)
def output(model: int, x: Floats, dx: Floats, theta: Floats, constants: Floats, current_a: float, psi: Floats) -> float:
    """Return the terminal voltage y^ [V]; write dy^/dtheta to ``psi`` (8,)."""
    if model == _CHEN_MORA:
        return chen_mora_sensitivity.output(x, dx, theta, constants, current_a, psi)
    if model == _FUEL_CELL:
        return fuel_cell.output(x, dx, theta, constants, current_a, psi)
    return math.nan


@njit(cache=True)
def write(model: int, theta: Floats, file: Floats, a: Floats) -> None:
    """Write the published parameters ``a`` (16,) from the file's and theta."""
    if model == _CHEN_MORA:
        chen_mora_sensitivity.write(theta, file, a)
    elif model == _FUEL_CELL:
        fuel_cell.write(theta, file, a)


@njit(cache=True)
def initialize_learning(s: Record, p: Record, voltage_v: float) -> None:
    """Initialize with the file's parameters, no information, and a cell at rest."""
    m, q = s.learning, p.learning
    for j in range(q.count):
        m.theta[j] = 0.0
    reset_information(m, q)
    s.observer.k = max(p.observer.k0, 1.0)
    initialize_states_at_rest(s, p, voltage_v)
    if abs(s.observer.current_a) <= RESTING_C * p.observer.capacity_as / 3600.0:
        m.settle_s = 0.0


@njit(cache=True)
def reset_information(m: Record, q: Record) -> None:
    """Set the accumulated information to zero."""
    m.waited_s = 0.0
    for j in range(q.count):
        m.pull[j] = 0.0
        for i in range(j + 1):
            m.information[j, i] = 0.0


@njit(cache=True)
def initialize_states_at_rest(s: Record, p: Record, voltage_v: float) -> None:
    """Initialize the states as those of a cell at rest.

    The voltage error becomes the injected offset and does not change the parameters. Learning is disabled for
    ``settle_s``, until effects of another initial state have decayed.
    """
    m, q, o = s.learning, p.learning, s.observer
    load_constants(q.model, m.given, p, o.soc, m.temperature_c)
    steady_state(q.model, m.x, m.dx, m.theta, m.given, o.current_a)
    injects = math.isfinite(q.offset_s)
    estimate_v = output(q.model, m.x, m.dx, m.theta, m.given, o.current_a, m.psi)
    m.offset_v = voltage_v - estimate_v if injects else 0.0
    for j in range(q.count):
        m.d_offset[j] = -m.psi[j] if injects else 0.0  # estimate plus offset does not depend on theta here
    m.settle_s = q.settle_s
    o.innovation_v = 0.0
    write_observer_state(s, p, voltage_v)


@njit(cache=True)
def learning_step(s: Record, p: Record, dt_s: float, previous_a: float, voltage_v: float) -> None:
    """Advance the learning law by one sample at the observer's present SOC.

    Args:
        s: Record of ESTIMATOR_STATE.
        p: Record of ESTIMATOR_SETTINGS.
        dt_s: Time since the previous sample [s].
        previous_a: Current at the previous sample [A].
        voltage_v: Measured voltage [V]; NaN if it was not measured at this sample.
    """
    m, q, o = s.learning, p.learning, s.observer
    load_constants(q.model, m.given, p, o.soc, m.temperature_c)
    unmeasured_s = p.observer.unmeasured_s
    mean_a = interpolated_current(dt_s, previous_a, o.current_a, unmeasured_s)
    advance(q.model, m.x, m.dx, m.theta, m.given, mean_a, dt_s)
    m.settle_s = max(m.settle_s - dt_s, 0.0) if dt_s <= unmeasured_s else q.settle_s
    if math.isfinite(voltage_v):
        learn_from_voltage(s, p, o.voltage_age_s, voltage_v)
    else:
        estimate_v = output(q.model, m.x, m.dx, m.theta, m.given, o.current_a, m.psi) + m.offset_v
        write_observer_state(s, p, estimate_v)


@njit(cache=True)
def learn_from_voltage(s: Record, p: Record, dt_s: float, voltage_v: float) -> None:
    """Correct the output and learn from a measured voltage [V], ``dt_s`` after the previous measured voltage."""
    m, q, o = s.learning, p.learning, s.observer
    e = voltage_v - output(q.model, m.x, m.dx, m.theta, m.given, o.current_a, m.psi) - m.offset_v
    o.innovation_v = e
    inject_output_error(m, q, dt_s, e)
    o.adapting = 0 if o.soc <= q.soc_floor else 1  # a fuel cell has no SOC and always adapts
    if o.adapting and m.settle_s == 0.0:
        accumulate_information(m, q, dt_s, e)
        m.waited_s += dt_s
        if m.waited_s >= LEARN_EVERY_S:
            if solve_parameter_step(m, q):
                apply_parameter_step(m, q, -math.expm1(-q.rate * o.k * m.waited_s))
                m.waited_s = 0.0
            else:
                reset_information(m, q)
        excess = max(abs(e) - p.observer.dead_zone_v, 0.0) / q.cells
        o.k = min(o.k + excess * excess * dt_s, MAX_RATE_HZ / q.rate)  # (3.13) with the dead zone of erratum 2
    estimate = output(q.model, m.x, m.dx, m.theta, m.given, o.current_a, m.psi) + m.offset_v
    write_observer_state(s, p, estimate)
    broken = not math.isfinite(estimate)
    lock_transition(o, p.observer, dt_s, broken)
    if broken:
        initialize_learning(s, p, voltage_v)


@njit(cache=True)
def inject_output_error(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Add a fraction of e to the offset, and update its sensitivities. ``m.psi`` becomes the sensitivity of y^ plus offset."""
    share = -math.expm1(-dt_s / q.offset_s)
    m.offset_v += share * e
    for j in range(q.count):
        m.psi[j] += m.d_offset[j]
        m.d_offset[j] -= share * m.psi[j]


@njit(cache=True)
def accumulate_information(m: Record, q: Record, dt_s: float, e: float) -> None:
    """Update Kreisselmeier's filters: psi psi' and psi (e + psi' theta).

    Old information is discounted only while the load provides new information.
    """
    psi_squared, target = 0.0, e
    for j in range(q.count):
        psi_squared += m.psi[j] * m.psi[j]
        target += m.psi[j] * m.theta[j]
    discount_information(m, q, dt_s / q.memory_s * psi_squared / (psi_squared + q.told_v * q.told_v))
    for j in range(q.count):
        m.pull[j] += dt_s * m.psi[j] * target
        for i in range(j + 1):
            m.information[j, i] += dt_s * m.psi[j] * m.psi[i]


@njit(cache=True)
def discount_information(m: Record, q: Record, exponent: float) -> None:
    """Discount the accumulated information by e^-``exponent``."""
    factor = math.exp(-exponent)
    for j in range(q.count):
        m.pull[j] *= factor
        for i in range(j + 1):
            m.information[j, i] *= factor


@njit(cache=True)
def solve_parameter_step(m: Record, q: Record) -> bool:
    """Write the step from theta to the solution of information and leakage to ``m.step``; return False if singular."""
    n = q.count
    for j in range(n):
        m.step[j] = m.pull[j] + q.leak_v2s[j] * (q.middle[j] - m.theta[j])
        for i in range(n):
            m.step[j] -= m.information[max(i, j), min(i, j)] * m.theta[i]
    if not cholesky_factor(m, q):
        return False
    for j in range(n):
        for i in range(j):
            m.step[j] -= m.factor[j, i] * m.step[i]
        m.step[j] /= m.factor[j, j]
    for j in range(n - 1, -1, -1):
        for i in range(j + 1, n):
            m.step[j] -= m.factor[i, j] * m.step[i]
        m.step[j] /= m.factor[j, j]
    return True


@njit(cache=True)
def cholesky_factor(m: Record, q: Record) -> bool:
    """Write the Cholesky factor of information plus leakage to ``m.factor``.

    Returns:
        False if the matrix is not positive definite, by rounding or a damaged state.
    """
    for j in range(q.count):
        pivot = m.information[j, j] + q.leak_v2s[j]
        for i in range(j):
            element = m.information[j, i]
            for h in range(i):
                element -= m.factor[j, h] * m.factor[i, h]
            m.factor[j, i] = element / m.factor[i, i]
            pivot -= m.factor[j, i] ** 2
        if not pivot > 0.0:
            return False
        m.factor[j, j] = math.sqrt(pivot)
    return True


@njit(cache=True)
def apply_parameter_step(m: Record, q: Record, share: float) -> None:
    """Move theta by ``share`` of the step within its bounds, and adjust the states to the new theta.

    The accumulated sensitivities belong to earlier values of theta. Information is therefore discounted with the squared step.
    """
    squared_step = 0.0
    for j in range(q.count):
        squared_step += m.step[j] * m.step[j]
        moved = min(max(m.theta[j] + share * m.step[j], q.lower[j]), q.upper[j])
        m.step[j] = moved - m.theta[j]
        m.theta[j] = moved
        m.offset_v += m.d_offset[j] * m.step[j]
        for branch in range(2):
            m.x[branch] += m.dx[branch, j] * m.step[j]
    discount_information(m, q, share * squared_step / (q.reach * q.reach))


@njit(cache=True)
def write_observer_state(s: Record, p: Record, estimate_v: float) -> None:
    """Write states, parameters, gain and estimated voltage of the learning law to the observer's record."""
    m, q, o = s.learning, p.learning, s.observer
    o.v_ts, o.v_tl = m.x[0], m.x[1]
    o.voltage_estimate_v = estimate_v
    o.gain = q.rate * o.k
    write(q.model, m.theta, q.file, o.a)
    if p.observer.capacity_as > 0.0:
        update_margins(o)
