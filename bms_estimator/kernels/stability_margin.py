"""Stability margin: SOC minus max(delta1, delta2), thesis 2.1.2.

delta1 (2.11) and delta2 (2.12) follow from a7..a12, the parameters of C_ts and C_tl. Before data have determined these
parameters, delta1 and delta2 are a property of the cell file's formula, and there is no margin.

``s`` is a record of ESTIMATOR_STATE, ``p`` of ESTIMATOR_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.kernels.identifier import MIN_BINS
from bms_estimator.kernels.kalman_filter.element_map import CAPACITANCES
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

VALID_FIT_STD = 0.5
"""Maximum relative std of a valid a1..a15. Amplitudes and exponents can be separated only after a sweep of the SOC."""
VALID_STD = 0.3
"""Maximum relative std of a valid circuit element, and of the resistances of the RC ladder for a valid time constant."""


@njit(cache=True)
def margin_with_std(s: Record, p: Record, soc_std: float) -> tuple[float, float]:
    """Return the stability margin and its std, both NaN unless max(delta1, delta2) is above 0 and a7..a12 are valid.

    a7..a12 are valid under the conditions of the payload ``parameters``. ``soc_std`` is the std of the SOC.
    """
    o = s.observer
    e = CAPACITANCES[0] if o.delta_1 >= o.delta_2 else CAPACITANCES[1]
    limit, limit_std = max(o.delta_1, o.delta_2), s.fit.delta_std[e]
    # ``limit_std`` is 0 from a checkpoint of an earlier version until the next fit
    is_identified = p.identify and not p.learning.enabled and p.filter.r_std < VALID_STD and limit_std > 0.0
    if not (limit > 0.0 and is_identified and has_valid_parameters(s, p, 2) and has_valid_parameters(s, p, 3)):
        return math.nan, math.nan
    i = 3 * e + 1
    # the observer's parameters differ from the fit while they converge, and if a bound limits them
    difference = delta(s.fit.a[i + 1], s.fit.a[i + 2], s.fit.a[i]) - limit
    return o.soc - limit, math.sqrt(soc_std * soc_std + limit_std * limit_std + difference * difference)


@njit(cache=True)
def has_valid_parameters(s: Record, p: Record, e: int) -> bool:
    """Return True if data have determined the three parameters of element ``e``, an index of ``ELEMENT_NAMES``."""
    o, fit = s.observer, s.fit
    if fit.bins[e] < MIN_BINS or not math.isfinite(s.unlearned_s[e]):
        return False
    for i in range(3 * e + 1, 3 * e + 4):
        std = math.sqrt(fit.std[i] ** 2 + (fit.a[i] - o.a[i]) ** 2)
        if o.target[i] == p.observer.target[i] or not std < VALID_FIT_STD * abs(o.a[i]):
            return False
    return True


@njit(cache=True)
def is_delta_configured(s: Record, p: Record) -> bool:
    """Return True if no data have changed delta1 and delta2. False for a fuel cell, which has neither.

    The identifier changes the limits of a7..a12. The learning law changes only the scale of C_ts and C_tl.
    """
    o = s.observer
    for i in range(3 * CAPACITANCES[0] + 1, 3 * CAPACITANCES[1] + 4):
        if o.target[i] != p.observer.target[i]:
            return False
    return not math.isnan(o.delta_1)
