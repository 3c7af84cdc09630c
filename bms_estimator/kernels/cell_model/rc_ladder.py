"""RC ladder of the overpotential: a series resistance and six RC pairs with fixed, log-spaced time constants.

The voltage of an RC pair is the current filtered with its time constant, x_k [A], times its resistance R_k(SOC, T).
Diffusion has no single time constant. A ladder approximates it from a second to an hour and is linear in the unknown R_k.
"""

import math

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit

TAU_S = (1.0, 6.0, 30.0, 120.0, 500.0, 2000.0)
"""Time constants of the RC pairs [s]."""
BRANCHES = len(TAU_S)
"""Number of RC pairs."""
RESISTANCES = 1 + BRANCHES
"""Number of resistances: the series resistance, then that of each RC pair."""
LOW_ACTIVATION_ENERGY = 12e3
"""Activation energy of the weak part of each resistance [J/mol]. This part depends weakly on temperature, like the electrolyte's
resistance."""
HIGH_ACTIVATION_ENERGY = 45e3
"""Activation energy of the strong part of each resistance [J/mol]. This part depends strongly on temperature, like the
resistances of reaction and diffusion."""
HYSTERESIS_ACTIVATION_ENERGY = 8e3
"""Activation energy of the hysteresis [J/mol]. Between C/30 curves of an LFP cell, less the drop of its RC network, the
hysteresis at 5 and -15 C was 1.2 and 1.7 times that at 25 C."""
GAS_CONSTANT = 8.314462618
"""Molar gas constant [J/(mol K)]."""
REFERENCE_C = 25.0
"""Temperature of the resistances and the OCV in a cell file [C]."""
GRID = 41
"""Number of nodes of resistances, entropy and hysteresis, evenly spaced over SOC 0..1."""

WEAK_SHARE = (0.80, 0.87, 0.94, 0.78, 0.64, 0.59, 0.57)
"""Default weak part as a fraction of each resistance, for captures at a single temperature. The values are those of an 18650
NCA cell from -10 to 33 C, mean over SOC 0.3 to 1. An LFP cell from -15 to 25 C has 0.8, 1, 0.9, 0.75, 0.7, 0.6, 0.6."""
WEAK_FACTOR_SOC = (0.0, 0.1, 0.2, 0.3, 0.45)
"""SOC nodes of ``WEAK_FACTOR``."""
WEAK_FACTOR = (0.45, 0.5, 0.8, 0.9, 1.0)
"""Factor on ``WEAK_SHARE`` near empty. At SOC 0.2 and 0.1 the measured factor is 0.73 and 0.14 in the NCA cell, 0.97
and 0.92 in the LFP cell."""

TREND_PAIR = 3
"""Index of the RC pair whose filtered current decides between charge and discharge: that of 120 s."""

TAUS = np.array(TAU_S)
"""Time constants of the RC pairs as an array for the kernels [s]."""


def weak_share(soc: Floats) -> Floats:
    """Return the default weak part as a fraction of each resistance at ``soc``, shape (RESISTANCES, n)."""
    return np.outer(np.array(WEAK_SHARE), np.interp(soc, WEAK_FACTOR_SOC, WEAK_FACTOR))


@njit(cache=True)
def arrhenius(energy_j: float, temperature_c: float) -> float:
    """Return the factor on a resistance with activation energy ``energy_j`` [J/mol]; 1 at 25 C."""
    return math.exp(energy_j / GAS_CONSTANT * (1.0 / (temperature_c + 273.15) - 1.0 / (REFERENCE_C + 273.15)))


@njit(cache=True)
def on_grid(soc: float, values: Floats) -> float:
    """Interpolate ``values`` at ``GRID`` nodes linearly at ``soc``; constant beyond the ends."""
    position = min(max(soc, 0.0), 1.0) * (GRID - 1)
    i = min(int(position), GRID - 2)
    return values[i] + (position - i) * (values[i + 1] - values[i])


@njit(cache=True)
def resistances(soc: float, weak_ohm: Floats, strong_ohm: Floats, weak: float, strong: float, ohm: Floats) -> None:
    """Write R_0..R_6 at ``soc`` [ohm] to ``ohm``.

    Args:
        soc: State of charge.
        weak_ohm: Shape (GRID, RESISTANCES), weak part at 25 C [ohm].
        strong_ohm: Shape (GRID, RESISTANCES), strong part at 25 C [ohm].
        weak: ``arrhenius(LOW_ACTIVATION_ENERGY, T)``.
        strong: ``arrhenius(HIGH_ACTIVATION_ENERGY, T)``.
        ohm: Shape (RESISTANCES,), written.
    """
    position = min(max(soc, 0.0), 1.0) * (GRID - 1)
    i = min(int(position), GRID - 2)
    t = position - i
    for k in range(RESISTANCES):
        a = weak * weak_ohm[i, k] + strong * strong_ohm[i, k]
        b = weak * weak_ohm[i + 1, k] + strong * strong_ohm[i + 1, k]
        ohm[k] = a + t * (b - a)
