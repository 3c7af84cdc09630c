"""How far the cell departs from two branches: the size of the model's error, learned from the innovations.

Innovations of a filter whose noises are right are white. Whatever the model cannot follow keeps its sign from sample to
sample, and neither the sensor's noise nor its declared size enters the product of one innovation with the next. Real
cells leave 2 to 10 % of the variance that the full model error predicts (``misfit`` 1), a simulated cell of two branches
0.5 % or less. So the model's error shrinks while that share stays below ``CORRELATED``, and grows back five times as
fast. It counts only while the branches are out of balance: at rest and at constant current any model fits.

``s`` is a record of IDENTIFIER_STATE, ``p`` of IDENTIFIER_SETTINGS.
"""

from numba import njit

from bms_estimator.kernels.identifier_state import CORRELATED, LEAST_MISFIT
from bms_estimator.kernels.state import Record

NOISE_AVERAGED = 4.0
"""So many samples, times the squared ratio of the sensor's noise to what is looked for, tell them apart."""
STEEPNESS = 3.0
FASTEST_GROWTH = 5.0
MOST_SHARE = 1.0
"""One sample says no more than this."""
LEAST_VARIANCE_V2 = 1e-14


@njit(cache=True)
def learn_misfit(s: Record, p: Record, dt_s: float, sensor_v2: float) -> None:
    """Take a believed innovation in.

    Args:
        s: Record of IDENTIFIER_STATE; its ``innovation_variance`` belongs to the innovation.
        p: Record of IDENTIFIER_SETTINGS.
        dt_s: Step [s].
        sensor_v2: The sensor's part of the variance [V^2].
    """
    predicted_v2 = max(s.innovation_variance - sensor_v2, LEAST_VARIANCE_V2)
    visible = min(1.0, s.unsettled_v2 / (p.excited_v * p.excited_v))
    noise = sensor_v2 / (predicted_v2 * CORRELATED)
    weight = visible * min(1.0, dt_s / (p.misfit_s + dt_s * NOISE_AVERAGED * noise * noise))
    share = min(max(s.innovation_v * s.believed_v / predicted_v2, -MOST_SHARE), MOST_SHARE)
    s.correlated += weight * (share - s.correlated)
    s.believed_v = s.innovation_v
    excess = min(max(STEEPNESS * (s.correlated / CORRELATED - 1.0), -1.0), FASTEST_GROWTH)
    s.misfit = min(max(s.misfit * (1.0 + weight * excess), LEAST_MISFIT), 1.0)
