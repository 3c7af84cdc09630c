"""Settings and state records of the whole estimator, and its trace: one row of values for each accepted sample.

Each part of ESTIMATOR_STATE has an owner, which writes it. Other kernels write only the fields of the last column:

=================  ================================  =======================================================================================
part               owner                             fields that others write
=================  ================================  =======================================================================================
observer           observer.observer                 all with a learning law: learning_law; a, soc, target: identifier; counters, time: step
pending            step                              -
current_check      current_check                     -
learning           observer.learning_law             settle_s: step; temperature_c: start
series_resistance  observer.series_resistance        settle_s: step
filter             kalman_filter                     current_a, step.phase, window, x_a, temperature_c: identifier, start, step
elements           kalman_filter.equivalent_circuit  -
checks             input_checks, frozen_sensor       outliers: current_check; slow_v, gated_*, mean_a, last_v: start, identifier
counters           kalman_filter.input_checks        -
anchors            kalman_filter.anchors             last, soc_before, soc_std_before, soc_after: identifier
map, fit           kalman_filter.element_map         -
history            accumulators.history              -
fit_age_s          identifier                        -
next_element       identifier                        -
unlearned_s        identifier                        start
unseen_s           ``Estimator.resume``              -
=================  ================================  =======================================================================================

Outside the kernels, only ``estimator`` writes fields. Exceptions: a worker of a fleet replaces the record and writes
``history.enabled``; the simulation of the thesis sets ``observer.v_ts`` and ``v_tl``. Other states of a pack are not in the record:
single cells (``estimator.cell_estimator``), rows and fits (``pack_model``), load (``forecast``), totals
(``telemetry.publish_window``), alarms (``telemetry.alarms``).

A checkpoint contains all parts. ``estimator.restore`` lists the parts that are restored although the identifier was off, and the
parts that must be finite.

A column of the trace with the name of a field of ``Estimate`` is published (``telemetry.state.COPIED``).

Numbers in parentheses are equations of the thesis.
"""

import numpy as np

from bms_estimator.kernels.accumulators.history import HISTORY
from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS
from bms_estimator.kernels.current_check import CURRENT_CHECK
from bms_estimator.kernels.kalman_filter.anchors import ANCHOR_SETTINGS, ANCHORS
from bms_estimator.kernels.kalman_filter.element_map import ELEMENT_FIT, ELEMENT_MAP, ELEMENTS
from bms_estimator.kernels.kalman_filter.equivalent_circuit import EQUIVALENT
from bms_estimator.kernels.kalman_filter.input_checks import CHECKS, COUNTERS
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, EKF_STATE
from bms_estimator.kernels.observer.records import LEARNING_SETTINGS, LEARNING_STATE, OBSERVER_SETTINGS, OBSERVER_STATE
from bms_estimator.kernels.observer.series_resistance import SERIES_RESISTANCE

ESTIMATOR_SETTINGS = np.dtype(
    [
        ("observer", OBSERVER_SETTINGS),
        ("learning", LEARNING_SETTINGS),
        ("filter", EKF_SETTINGS),
        ("anchors", ANCHOR_SETTINGS),
        ("identify", "i8"),  # 1: the filter runs; 0: SOC by coulomb counting, parameters as configured
        ("series_resistance", "i8"),  # 1: R_s by (4.2), step 3 of the thesis
        ("sets_targets", "i8"),  # 1: identified parameters become the limits of the adaptive law (3.18)
        ("configured", "f8", PARAMETERS),  # a1..a15 of the cell file
        ("lower", "f8", PARAMETERS),  # configured lower bounds of the parameters that become limits of (3.18)
        ("upper", "f8", PARAMETERS),  # upper bounds
        ("map_memory_s", "f8"),  # time constant with which the map discounts data [s]
    ],
    align=True,
)

PENDING_VOLTAGE = np.dtype(
    [
        ("age_s", "f8"),  # time from the last measured current to this voltage [s]; 0: none
        ("voltage_v", "f8"),  # [V]
    ],
    align=True,
)
"""Voltage that waits for the next measured current."""

ESTIMATOR_STATE = np.dtype(
    [
        ("observer", OBSERVER_STATE),
        ("pending", PENDING_VOLTAGE),
        ("current_check", CURRENT_CHECK),
        ("learning", LEARNING_STATE),
        ("series_resistance", SERIES_RESISTANCE),
        ("filter", EKF_STATE),
        ("elements", EQUIVALENT),  # circuit equivalent to the filter's ladder at the present SOC and temperature
        ("checks", CHECKS),
        ("counters", COUNTERS),
        ("anchors", ANCHORS),
        ("map", ELEMENT_MAP),
        ("fit", ELEMENT_FIT),
        ("history", HISTORY),
        ("fit_age_s", "f8"),  # time since the last fit of an element [s]
        ("next_element", "i8"),  # index of the element to be fitted next
        ("unseen_s", "f8"),  # gap before the first sample with a new time base [s]; infinite if unknown
        # time since the map's last observation of each element [s]; infinite: none yet
        ("unlearned_s", "f8", ELEMENTS),
    ],
    align=True,
)
"""Complete state of the estimator."""

TRACE = np.dtype(
    [
        ("time_s", "f8"),
        ("voltage_v", "f8"),
        ("current_a", "f8"),  # positive on discharge
        ("temperature_c", "f8"),
        ("soc", "f8"),
        # predicted by the identifier for its last update; without the identifier, the observer's y^ [V]
        ("voltage_estimate_v", "f8"),
        # measured minus predicted voltage of the identifier; without the identifier, the observer's e [V]
        ("innovation_v", "f8"),
        ("tracking_error_v", "f8"),  # the observer's e (3.15)
        ("nussbaum_gain", "f8"),  # N(k) (3.12) of a law of the thesis, or NaN
        ("adaptation_gain_hz", "f8"),  # gamma k of the learning law, or NaN [1/s]
        ("k", "f8"),  # adaptive gain state (3.13)
        ("delta_1", "f8"),  # SOC below which C_ts of the model is negative (2.11)
        ("delta_2", "f8"),  # SOC below which C_tl of the model is negative (2.12)
        ("delta_configured", "i8"),  # 1: no data have changed delta_1 and delta_2
        ("stability_margin", "f8"),  # soc - max(delta_1, delta_2), or NaN (``kernels/identifier.py``)
        ("stability_margin_std", "f8"),
        ("lock", "i8"),  # 1 while the observer tracks the voltage
        ("converged", "i8"),  # 1: |e| < eps2 of Algorithm 1
        ("soc_coulomb", "f8"),  # by coulomb counting alone
        # from the inverted OCV (7.1); this column and all later ones belong to the identifier and are NaN without it
        ("soc_ocv", "f8"),
        ("soc_std", "f8"),
        ("r_s_ohm", "f8"),
        ("r_s_std_ohm", "f8"),
        ("r_ts_ohm", "f8"),
        ("r_ts_std_ohm", "f8"),
        ("tau_ts_s", "f8"),
        ("tau_ts_std_s", "f8"),
        ("r_tl_ohm", "f8"),
        ("r_tl_std_ohm", "f8"),
        ("tau_tl_s", "f8"),
        ("tau_tl_std_s", "f8"),
    ],
    align=True,
)
"""Values of one accepted sample."""
