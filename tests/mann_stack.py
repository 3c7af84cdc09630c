"""Simulation of a PEM stack for tests and the benchmark of the fuel cell.

The losses are those of Mann et al. (2000) with the coefficients of Correa et al. (2004), as in ``pem_30w``. The stack has
additional effects that the model omits: a membrane resistance that depends on current, temperature and a water content with a
lag of a minute, oxygen with a lag of 0.3 s, self-heating by some K, and a reaction that also runs backwards (Butler-Volmer).
"""

import math
from typing import NamedTuple

import numpy as np

from bms_estimator.kernels.cell_model.fuel_cell import open_loop
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

CELLS, AREA_CM2, MEMBRANE_CM = 14, 20.0, 0.0178
XI_1, XI_3, XI_4 = -0.948, 7.6e-5, -1.93e-4
"""Coefficients of Mann's activation loss. ``xi_2`` depends on the temperature: see ``_activation_v``."""
B_V, LIMIT_A, INTERNAL_A = 0.016, 0.469 * AREA_CM2, 0.003 * AREA_CM2
"""Factor of the concentration loss [V], limiting current and internal current [A]; Correa gives A/cm^2."""
C_FARAD, CONTACT_OHM = 3.0 / 64.0 * AREA_CM2, 0.0003 * 64.0 / AREA_CM2
"""Double-layer capacitance and contact resistance of a cell: 3 F and 0.3 mohm at Correa's 64 cm^2, scaled by area."""
HYDROGEN_ATM, OXYGEN_ATM = 1.0, 0.21
WATER_S, OXYGEN_S, WARM_S = 60.0, 0.3, 300.0
"""Time constants of water content, oxygen and temperature [s]."""
NO_LOAD_WATER = 12.0
"""Water content of the membrane without load [molecules per sulfonic group]."""
WATER_PER_AMPERE = 0.5
"""Increase of the water content per ampere [1/A]."""
NO_LOAD_C = 35.0
"""Temperature without load [C]."""
WARM_K = 6.0
"""Increase of the temperature at ``FULL_W`` [K]."""
FULL_W = 30.0
CURVE_A = np.array([0, 0.05, 0.1, 0.2, 0.4, 0.7, 1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 5.5, 6, 6.5, 7, 7.5, 8, 8.5])
"""Points of a polarization curve [A]."""
SUBSTEP_S = 5e-4
"""Maximum integration step [s]."""
NOISE_V = 0.003
RESOLUTION_V = 0.001


class Record(NamedTuple):
    """Measured columns and the true resistance, shape (n,) each."""

    time_s: Floats
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats
    r_ohm: Floats

    def every(self, n: int) -> "Record":
        """Return every n-th sample, as a slower board would: the current then also steps between samples."""
        return Record(*(column[::n] for column in self))


def measured(
    time_s: Floats, current_a: Floats, *, seed: int = 0, noise_v: float = NOISE_V, more_ohm: Floats | float = 0.0
) -> Record:
    """Return voltage and temperature of the stack, from the steady state. A current is constant until the next sample.

    Args:
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), not negative [A].
        seed: Seed of the noise.
        noise_v: Standard deviation of a voltage [V].
        more_ohm: Resistance in addition to that of the stack, a number or shape (n,) [ohm].
    """
    growth = np.broadcast_to(np.asarray(more_ohm, dtype=float), time_s.shape).copy()
    voltage_v, temperature_c, r_ohm = _run(np.asarray(time_s, dtype=float), np.asarray(current_a, dtype=float), growth)
    noisy = voltage_v + np.random.default_rng(seed).normal(0.0, noise_v, time_s.size)
    rounded = np.round(noisy / RESOLUTION_V) * RESOLUTION_V
    return Record(time_s, current_a, rounded, np.round(temperature_c, 1), r_ohm)


def curve(currents_a: Floats, *, seed: int = 0, noise_v: float = NOISE_V) -> Record:
    """Return a polarization curve: voltage and temperature in the steady state of each current."""
    time_s = np.arange(3.0)
    last = [measured(time_s, np.full(time_s.size, i), seed=seed + k, noise_v=noise_v) for k, i in enumerate(currents_a)]
    columns = (np.array([getattr(record, name)[-1] for record in last]) for name in Record._fields)
    return Record(*columns)


def random_steps(duration_s: float, rate_hz: float, *, seed: int, highest_a: float = 5.0) -> tuple[Floats, Floats]:
    """Return time [s] and a current of random steps of 0.5 to 5 s between 0.2 A and ``highest_a`` [A]."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(duration_s * rate_hz)) / rate_hz
    starts_s = np.cumsum(rng.uniform(0.5, 5.0, math.ceil(duration_s / 0.5)))
    levels_a = rng.uniform(0.2, highest_a, starts_s.size + 1)
    return time_s, levels_a[np.searchsorted(starts_s, time_s)]


def model_itself(a: Floats, duration_s: float, *, seed: int = 0, noise_v: float = NOISE_V) -> Record:
    """Return samples at 100 Hz of the estimator's own model with the kernel constants ``a``, shape (16,).

    The current steps between samples, because every fifth sample of a simulation at 500 Hz is kept.
    """
    time_s, current_a = random_steps(duration_s, 500.0, seed=seed)
    no_temperature = np.full(time_s.size, np.nan)
    voltage_v, _ = open_loop(a, np.zeros(8), time_s, current_a, no_temperature)
    voltage_v += np.random.default_rng(seed).normal(0.0, noise_v, time_s.size)
    return Record(time_s, current_a, voltage_v, no_temperature, no_temperature).every(5)


@njit(cache=True)
def _cell_ohm(current_a: float, kelvin: float, water: float) -> float:
    """Return the resistance of a cell: Mann's membrane resistivity, and the contact."""
    density = current_a / AREA_CM2
    numerator = 181.6 * (1.0 + 0.03 * density + 0.062 * (kelvin / 303.0) ** 2 * density**2.5)
    denominator = (water - 0.634 - 3.0 * density) * math.exp(4.18 * (kelvin - 303.0) / kelvin)
    return numerator / denominator * MEMBRANE_CM / AREA_CM2 + CONTACT_OHM


@njit(cache=True)
def _activation_v(kelvin: float) -> float:
    hydrogen = HYDROGEN_ATM / (1.09e6 * math.exp(77.0 / kelvin))
    oxygen = OXYGEN_ATM / (5.08e6 * math.exp(-498.0 / kelvin))
    xi_2 = 0.00286 + 0.0002 * math.log(AREA_CM2) + 4.3e-5 * math.log(hydrogen)
    return -(XI_1 + xi_2 * kelvin + XI_3 * kelvin * math.log(oxygen))


@njit(cache=True)
def _nernst_v(kelvin: float) -> float:
    gases = math.log(HYDROGEN_ATM) + 0.5 * math.log(OXYGEN_ATM)
    return 1.229 - 8.5e-4 * (kelvin - 298.15) + 4.3085e-5 * kelvin * gases


@njit(cache=True)
def _run(time_s: Floats, current_a: Floats, more_ohm: Floats) -> tuple[Floats, Floats, Floats]:
    n = time_s.size
    voltage_v, temperature_c, r_ohm = np.empty(n), np.empty(n), np.empty(n)
    kelvin, water = NO_LOAD_C + 273.15, NO_LOAD_WATER + WATER_PER_AMPERE * current_a[0]
    oxygen = 1.0 - (current_a[0] + INTERNAL_A) / LIMIT_A
    loss_v = 0.0
    for _ in range(20):  # iterate the steady-state temperature under the first current
        loss_v = _activation_v(kelvin) - XI_4 * kelvin * math.log(current_a[0] + INTERNAL_A) - B_V * math.log(oxygen)
        start_v = CELLS * (_nernst_v(kelvin) - loss_v - current_a[0] * _cell_ohm(current_a[0], kelvin, water))
        kelvin = 273.15 + NO_LOAD_C + WARM_K * current_a[0] * start_v / FULL_W
    for j in range(n):
        if j > 0:
            remaining_s, i = time_s[j] - time_s[j - 1], current_a[j - 1]
            while remaining_s > 1e-9:
                dt_s = min(SUBSTEP_S, remaining_s)
                remaining_s -= dt_s
                tafel_v = -XI_4 * kelvin
                exchange_a = math.exp(-_activation_v(kelvin) / tafel_v)
                forward = math.exp((loss_v + B_V * math.log(oxygen)) / tafel_v)
                reaction_a = exchange_a * (forward - math.exp(-loss_v / tafel_v))
                loss_v += dt_s * (i + INTERNAL_A - reaction_a) / C_FARAD
                oxygen += dt_s / OXYGEN_S * (max(1.0 - (i + INTERNAL_A) / LIMIT_A, 0.01) - oxygen)
                water += dt_s / WATER_S * (NO_LOAD_WATER + WATER_PER_AMPERE * i - water)
                warm_k = WARM_K * i * voltage_v[j - 1] / FULL_W
                kelvin += dt_s / WARM_S * (273.15 + NO_LOAD_C + warm_k - kelvin)
        r_ohm[j] = CELLS * _cell_ohm(current_a[j], kelvin, water) + more_ohm[j]
        voltage_v[j] = CELLS * (_nernst_v(kelvin) - loss_v) - current_a[j] * r_ohm[j]
        temperature_c[j] = kelvin - 273.15
    return voltage_v, temperature_c, r_ohm
