"""Where the model stays stable: delta1, delta2, and the bound that a8 and a11 must exceed."""

import math

from bms_estimator.numba_cache import njit


@njit(cache=True)
def delta(exponent: float, offset: float, amplitude: float) -> float:
    """SOC below which a capacitance -amplitude e^(-exponent SOC) + offset is negative: (2.11), (2.12).

    delta1 = delta(a8, a9, a7), delta2 = delta(a11, a12, a10). Negative when the capacitance is
    positive over the whole of 0..1.
    """
    return -math.log(offset / amplitude) / exponent  # (2.11), (2.12)


@njit(cache=True)
def crossing(soc: float, offset: float, amplitude: float) -> float:
    """The bound that a8 (a11) must exceed at ``soc``: right side of the condition in Lemma 4.1.1, Fig. 19."""
    return -math.log(offset / amplitude) / soc
