"""Simulation of cells that differ from the estimator's model.

A cell has eight processes, each with another time constant and activation energy than the RC pairs of the estimator. One process
has Butler-Volmer kinetics, so that its resistance falls with the current. The OCV has a fast and a slow hysteresis and an
entropy term. Resistances rise towards empty and full.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.numba_cache import njit

GRID = np.linspace(0.0, 1.0, 401)
"""SOC grid of the true cells."""
TAU_S = np.array([0.0, 0.4, 3.0, 17.0, 70.0, 300.0, 1200.0, 4000.0])
"""Time constants of the processes at 25 C [s]; 0 for the series resistance."""
ENERGY_J = np.array([10e3, 42e3, 48e3, 38e3, 30e3, 28e3, 26e3, 24e3])
"""Activation energies of the resistances of the processes [J/mol]. A time constant has half of this activation energy."""
KINETIC = 2
"""Index of the process with Butler-Volmer kinetics: charge transfer, 3 s."""
KINETIC_V = 0.051
"""Overpotential 2 R T / F above which the resistance of charge transfer falls [V]."""
COOLING_S = 900.0
"""Thermal time constant of a cell [s]."""
GAS_CONSTANT, KELVIN, REFERENCE_K = 8.314462618, 273.15, 298.15
"""Gas constant [J/mol/K], 0 C and 25 C [K]."""
TAPER_C = 0.05
"""Current at which a charger ends its charge [C]."""
STATE_X = 5
"""Index of the first filtered current in the state of a simulation."""
LOOPS_SOC, FAST_FRACTION = (0.015, 0.15), 0.6
"""SOC changes over which the fast and the slow hysteresis go from their middle to their limit, and fraction of the hysteresis
that is fast.

Both are stop operators (Prandtl), so that regeneration moves the hysteresis only in proportion to the regenerated charge.
"""


@dataclass(frozen=True)
class Truth:
    """True cell. Arrays of shape (401,) are over ``GRID``."""

    capacity_ah: float
    ocv_v: Floats
    per_kelvin_v: Floats
    """Change of the OCV per kelvin (entropy term) [V/K]."""
    hysteresis_v: Floats
    """Half of the difference between the OCV after charge and the OCV after discharge [V]."""
    ohm: Floats
    """Resistances at 25 C and small currents, shape (401, 8) [ohm]."""


@njit(cache=True)
def interpolate(soc, values):
    """Interpolate values at ``GRID`` linearly."""
    position = min(max(soc, 0.0), 1.0) * (len(values) - 1)
    i = min(int(position), len(values) - 2)
    return values[i] + (position - i) * (values[i + 1] - values[i])


@njit(cache=True)
def simulate(
    dt_s,
    current_a,
    room_c,
    soc,
    hysteresis,
    capacity_ah,
    ocv_v,
    per_kelvin_v,
    hysteresis_v,
    ohm,
    self_heating_k_per_w=0.0,
    low_v=-math.inf,
    high_v=math.inf,
):
    """Return terminal voltage [V] and SOC at each sample, from rest at ``soc``. See ``simulate_from``.

    ``hysteresis`` is the initial state: -1 after a discharge, 1 after a charge.
    """
    state = rest_state(soc, hysteresis)
    curves = ocv_v, per_kelvin_v, hysteresis_v, ohm
    return simulate_from(state, dt_s, current_a, room_c, capacity_ah, *curves, self_heating_k_per_w, low_v, high_v)


@njit(cache=True)
def rest_state(soc, hysteresis):
    """Return the state of a cell at rest, for ``simulate_from``.

    Its elements are SOC, the two states of the hysteresis (fast, slow; -1..1), the cell temperature minus the room
    temperature [K], the sign of the current that a limit has stopped, and the low-pass filtered currents of the
    processes [A].
    """
    state = np.zeros(STATE_X + len(TAU_S))
    state[:STATE_X] = soc, hysteresis, hysteresis, 0.0, 0.0
    return state


@njit(cache=True)
def simulate_from(
    state,
    dt_s,
    current_a,
    room_c,
    capacity_ah,
    ocv_v,
    per_kelvin_v,
    hysteresis_v,
    ohm,
    self_heating_k_per_w,
    low_v,
    high_v,
):
    """Return terminal voltage [V] and SOC at each sample, from ``state`` on. The current is constant until the next
    sample.

    The temperature of the cell finally exceeds the room temperature ``room_c`` by ``self_heating_k_per_w`` times the
    loss. A charger limits the voltage to ``high_v`` [V] and stops at C/20. A protection ends the discharge below
    ``low_v`` [V]. The function writes the current that flowed to ``current_a`` [A], and the state after the last sample
    to ``state``.
    """
    voltage_v, true_soc = np.empty(len(current_a)), np.empty(len(current_a))
    soc, fast, slow, rise_k, stopped = state[0], state[1], state[2], state[3], state[4]
    x = state[STATE_X:]
    for n in range(len(current_a)):
        i, celsius = current_a[n], room_c[n] + rise_k
        if i * stopped > 0.0:
            i = 0.0
        elif i != 0.0:
            stopped = 0.0
        inverse_temperature = (1.0 / (celsius + KELVIN) - 1.0 / REFERENCE_K) / GAS_CONSTANT
        x[0] = i
        open_v = interpolate(soc, ocv_v) + (celsius - 25.0) * interpolate(soc, per_kelvin_v)
        v = open_v + interpolate(soc, hysteresis_v) * (FAST_FRACTION * fast + (1.0 - FAST_FRACTION) * slow)
        for k in range(len(TAU_S)):
            drop_v = x[k] * interpolate(soc, ohm[:, k]) * math.exp(ENERGY_J[k] * inverse_temperature)
            v -= KINETIC_V * math.asinh(drop_v / KINETIC_V) if k == KINETIC else drop_v
        if i < 0.0 and v > high_v:
            series_ohm = interpolate(soc, ohm[:, 0]) * math.exp(ENERGY_J[0] * inverse_temperature)
            held_a = min(i + (v - high_v) / series_ohm, 0.0)
            v -= series_ohm * (held_a - i)
            i = held_a
            if i > -TAPER_C * capacity_ah:
                stopped = -1.0
        elif i > 0.0 and v < low_v:
            stopped = 1.0
        current_a[n] = i
        voltage_v[n], true_soc[n] = v, soc
        rise_k += (self_heating_k_per_w * i * (open_v - v) - rise_k) * dt_s / COOLING_S
        drawn_soc = i * dt_s / 3600.0 / capacity_ah
        soc -= drawn_soc
        for k in range(1, len(TAU_S)):
            x[k] = i + (x[k] - i) * math.exp(-dt_s / (TAU_S[k] * math.exp(0.5 * ENERGY_J[k] * inverse_temperature)))
        fast = min(max(fast - drawn_soc / LOOPS_SOC[0], -1.0), 1.0)
        slow = min(max(slow - drawn_soc / LOOPS_SOC[1], -1.0), 1.0)
    state[0], state[1], state[2], state[3], state[4] = soc, fast, slow, rise_k, stopped
    return voltage_v, true_soc


def impedance(truth: Truth, node: int, temperature_c: float, rad_s: Floats, current_a: float) -> Floats:
    """Return the complex impedance at ``GRID[node]`` and angular frequencies ``rad_s`` [ohm].

    The resistance of charge transfer depends on the current and is taken at ``current_a``.
    """
    arrhenius_factor = np.exp(ENERGY_J / GAS_CONSTANT * (1.0 / (temperature_c + KELVIN) - 1.0 / REFERENCE_K))
    ohm = truth.ohm[node] * arrhenius_factor
    drop = ohm[KINETIC] * current_a / KINETIC_V
    ohm[KINETIC] *= math.asinh(drop) / drop
    return (ohm / (1.0 + 1j * rad_s[:, None] * TAU_S * np.sqrt(arrhenius_factor))).sum(axis=1)


def u_shape(low: float, high: float) -> Floats:
    """Return a factor over ``GRID`` that rises from about 1 by ``low`` towards empty and by ``high`` towards full."""
    return 1.0 + low * np.exp(-GRID / 0.07) + high * np.exp((GRID - 1.0) / 0.05) + 0.15 * np.cos(5.0 * GRID)


def resistances(milliohm: tuple[float, ...]) -> Floats:
    """Return the resistances of the eight processes over SOC, shape (401, 8) [ohm], from those at mid SOC [mohm]."""
    shapes = [u_shape(0.4, 0.0), u_shape(1.0, 0.3), u_shape(2.5, 0.8), u_shape(2.0, 0.5), *4 * [u_shape(3.0, 0.2)]]
    return 1e-3 * np.array(milliohm) * np.column_stack(shapes)


def smooth(rng: np.random.Generator, length_soc: float) -> Floats:
    """Return a random smooth curve over ``GRID``: a normal process of variance 1 with the correlation length
    ``length_soc``."""
    # Sum of waves with a Gaussian spectrum. Waves beyond k * length_soc = 4 are negligible.
    k = np.pi * np.arange(0.0, 4.0 / length_soc / np.pi)
    amplitude = np.exp(-0.25 * (k * length_soc) ** 2)
    cosines, sines = rng.standard_normal((2, k.size)) * amplitude / np.sqrt(np.sum(amplitude**2))
    angle = np.outer(GRID, k)
    return np.cos(angle) @ cosines + np.sin(angle) @ sines


def curve_of(name: str) -> Floats:
    """Return the OCV of a generic cell at ``GRID`` [V]."""
    ocv = load_cell(name, 1.0).ocv
    assert isinstance(ocv, TableOcv)
    return PchipInterpolator(ocv.soc, ocv.ocv_v)(GRID)


def measured_curve() -> Floats:
    """Return the measured OCV of an LG M50 (NMC811 with silicon in the graphite) at ``GRID`` [V]."""
    table = np.genfromtxt(Path(__file__).parents[2] / "data" / "lgm50" / "ocv_25c.csv", delimiter=",", names=True)
    return PchipInterpolator(table["soc"], table["ocv_v"])(GRID)
