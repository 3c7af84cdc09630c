"""Nussbaum gains N(k) of section 2.2.2 and (3.10) of the thesis."""

import math
from enum import IntEnum

from bms_estimator.kernels.observer.mittag_leffler import mittag_leffler
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit


class Nussbaum(IntEnum):
    """Nussbaum function N(k), the gain of the observer."""

    MITTAG_LEFFLER = 0  # E_a(-lambda k^a), (3.10) with the sign of erratum 1 in docs/theory/thesis.md
    K2_COS = 1  # N1 = k^2 cos k
    K_COS_SQRT = 2  # N2 = k cos sqrt|k|
    LN_COS_SQRT_LN = 3  # N3 = ln k cos sqrt(ln k), k > 1


# constants of the compiled function, plain integers as the record's field ``nussbaum``
_K2_COS = int(Nussbaum.K2_COS)
_K_COS_SQRT = int(Nussbaum.K_COS_SQRT)
_LN_COS_SQRT_LN = int(Nussbaum.LN_COS_SQRT_LN)


@njit(cache=True)
def nussbaum_gain(k: float, p: Record) -> float:
    """Return N(k), clamped to +-``gain_limit``.

    Args:
        k: Adaptive gain state (3.13) [V^2 s].
        p: Record of dtype ``OBSERVER_SETTINGS``.
    """
    if p.nussbaum == _K2_COS:
        gain = k * k * math.cos(k)
    elif p.nussbaum == _K_COS_SQRT:
        gain = k * math.cos(math.sqrt(abs(k)))
    elif p.nussbaum == _LN_COS_SQRT_LN:
        log_k = math.log(max(k, 1.0))
        gain = log_k * math.cos(math.sqrt(log_k))
    else:  # lambda k^a = (gain_scale k)^a, because gain_scale is lambda^(1/a)
        gain = mittag_leffler(p.gain_scale * k, p.alpha, p.ml_series, p.ml_decay, p.ml_decay_slope)
    return min(max(gain, -p.gain_limit), p.gain_limit)
