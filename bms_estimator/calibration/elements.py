"""a1..a15 as the free numbers of a fit, theta: every value of theta is a cell whose elements are positive.

The resistances' parameters (2.5), (2.6), (2.9) and the capacitances' exponents and offsets go as logarithms. A
capacitance's amplitude goes as the SOC where (2.7), (2.8) cross zero: delta1, delta2 of (2.11), (2.12).
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SIZE = 15
NAMES = tuple(f"a{i}" for i in range(1, SIZE + 1))
DELTAS = (6, 9)
"""Places of delta1, delta2 in theta, which stand for a7, a10."""
_RESISTANCE = np.log([[1e-3, 5.0], [0.5, 200.0], [1e-2, 10.0]])
"""Amplitude and offset in ``scale_ohm``, exponent."""
_LEAST_DELTA, _MOST_DELTA = -1.0, 0.02
"""Above 0.02 a cell could not be used; below -1 a capacitance does not depend on SOC."""
_TAU_S = ((2.0, 400.0), (100.0, 2e4))
"""Limits of offset capacitance times ``scale_ohm``, short-term and long-term [s]; they keep the two apart."""

FLAT = 0.01
"""An amplitude below this part of the offset says that the file knows of no dependence on SOC."""
ORDINARY_R, ORDINARY_C, ORDINARY_EXPONENT = 2.0, 0.8, 20.0
"""Amplitudes in parts of the offset, and exponent, of 18650 cells, roughly."""


def limits(scale_ohm: float) -> tuple[Floats, Floats]:
    """Least and greatest theta for a cell with a series resistance of about ``scale_ohm`` [ohm]."""
    ohm = np.array([[np.log(scale_ohm)] * 2, [0.0, 0.0], [np.log(scale_ohm)] * 2])
    resistance = _RESISTANCE + ohm
    capacitance = [
        np.array([[_LEAST_DELTA, _MOST_DELTA], np.log([0.5, 200.0]), np.log(np.array(tau) / scale_ohm)])
        for tau in _TAU_S
    ]
    table = np.vstack([resistance, resistance, *capacitance, resistance])
    return np.array(table[:, 0]), np.array(table[:, 1])


def to_a(theta: Floats) -> Floats:
    """a1..a15 at index 1..15; shape (16,), the first NaN."""
    a = np.full(SIZE + 1, np.nan)
    a[1:] = np.exp(theta)
    for d in DELTAS:
        a[d + 1] = a[d + 3] * np.exp(a[d + 2] * theta[d])  # (2.11), (2.12) solved for the amplitude
    return a


def from_a(a: Floats) -> Floats:
    """Theta of a1..a15 at index 1..15."""
    theta = np.log(a[1 : SIZE + 1])
    for d in DELTAS:
        theta[d] = np.log(a[d + 1] / a[d + 3]) / a[d + 2]
    return np.asarray(theta, dtype=np.float64)


def start(a: Floats) -> Floats:
    """Theta to start a search from.

    An element that the file has flat over SOC gets an ordinary bend towards empty: a fit could not find its exponent.
    """
    bent = a.copy()
    for first in (1, 4, 7, 10, 13):
        amplitude, offset = a[first], a[first + 2]
        if amplitude < FLAT * offset:
            part = ORDINARY_C if first in (7, 10) else ORDINARY_R
            bent[first], bent[first + 1] = part * offset, ORDINARY_EXPONENT
    return from_a(bent)


def by_theta(theta: Floats) -> Floats:
    """Da/dtheta, shape (15, 15)."""
    a = to_a(theta)
    table = np.diag(a[1:])
    for d in DELTAS:
        amplitude, exponent = a[d + 1], a[d + 2]
        table[d, d : d + 3] = amplitude * exponent, amplitude * exponent * theta[d], amplitude
    return np.asarray(table, dtype=np.float64)
