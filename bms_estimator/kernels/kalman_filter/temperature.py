"""Self-heating of a cell without a temperature sensor.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS.
"""

import math

from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    HIGH_ACTIVATION_ENERGY,
    HYSTERESIS_ACTIVATION_ENERGY,
    LOW_ACTIVATION_ENERGY,
    REFERENCE_C,
    arrhenius,
    resistances,
)
from bms_estimator.kernels.kalman_filter.records import (
    LN_R,
    LN_R0,
    X,
)
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

TEMPERATURE_S = 10.0
"""Averaging time of a temperature sensor's noise [s]."""

MAX_RATE_K_S = 0.1
"""Maximum rate of change of a cell's temperature [K/s]."""

RATE_LIMIT_DELAY_S = 60.0
"""Delay until the rate limit of the temperature applies [s], because some sensors report 85 C at first."""

HEAT_J = 22.0
"""Heat capacity per Ah of a cell [J/(K Ah)]. Fits to an LG M50 at C/2 and 1C give 22 and 24 J/(K Ah)."""
COOLING_S = 600.0
"""Time constant of a cell's cooling in still air [s]. Fits to an LG M50 at C/2 and 1C give 650 and 570 s."""
MAX_MODELLED_C = 80.0
"""Maximum modelled temperature [C], so that a wrong current does not cause an implausible temperature for an hour."""


@njit(cache=True)
def propagate_self_heating(s: Record, p: Record) -> None:
    """Model the temperature at the end of the window by losses i^2 R_0 + sum x_k^2 R_k, in air of ``REFERENCE_C``."""
    w, x = s.window, s.mean[s.best]
    resistances(s.soc, p.weak_ohm, p.strong_ohm, s.weak, s.strong, s.ohm)
    current_a = w.charge_as / w.time_s
    loss_w = math.exp(x[LN_R0]) * s.ohm[0] * current_a * current_a
    for k in range(BRANCHES):
        loss_w += math.exp(x[LN_R]) * s.ohm[1 + k] * (s.x_a[k] + x[X + k]) ** 2
    steady_c = REFERENCE_C + loss_w / p.series * COOLING_S / (HEAT_J * p.capacity_as / 3600.0)
    s.temperature_c = steady_c + (s.temperature_c - steady_c) * math.exp(-w.time_s / COOLING_S)
    s.temperature_c = min(s.temperature_c, MAX_MODELLED_C)


@njit(cache=True)
def update_arrhenius_factors(s: Record) -> None:
    """Compute the Arrhenius factors at the cell's temperature."""
    s.weak, s.strong = (
        arrhenius(LOW_ACTIVATION_ENERGY, s.temperature_c),
        arrhenius(HIGH_ACTIVATION_ENERGY, s.temperature_c),
    )
    s.hysteresis = arrhenius(HYSTERESIS_ACTIVATION_ENERGY, s.temperature_c)
