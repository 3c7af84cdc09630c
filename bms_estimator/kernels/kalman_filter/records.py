"""The extended Kalman filter: state vector, settings with their origin, and records.

The state vector, in this order (also of the rows and columns of the covariance):

====  =========  ==============================================================================================
  0   SOC        state of charge z
1-6   X          x_k in the branches of the ladder beyond what the current since switch-on explains [A]
  7   LN_R0      ln of the true over the file's series resistance
  8   LN_R       the same of all branches
  9   B_SLOW     error of the model that stays for hours [V]
 10   B_FAST     error of the model that stays for a minute [V]
 11   OFFSET     measured less true current [A]
 12   LN_Q       ln(true / declared capacity); a wrong gain of the current sensor looks the same
 13   HYST       hysteresis h, -1 after discharge, 1 after charge
 14   CURVE      error of the OCV at this SOC, here and now, in units of its standard deviation
15-   NODE       error of the OCV curve at ``NODES`` SOCs from 0 to 1, in the same units: learned (``ocv_correction``)
====  =========  ==============================================================================================

Several such filters run side by side from different SOCs until they agree (``hypotheses``).
"""

from dataclasses import dataclass, fields

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, RESISTANCES

SOC, X = 0, 1
LN_R0, LN_R, B_SLOW, B_FAST, OFFSET, LN_Q, HYST, CURVE = range(X + BRANCHES, X + BRANCHES + 8)
NODE, NODES = CURVE + 1, 21
STATES = NODE + NODES
HYPOTHESES = 7


@dataclass(frozen=True)
class Noise:
    """Uncertainties of one cell in series. 1 C is the current that empties the cell in an hour."""

    model_v: float = 0.05
    """R: error of the ladder in the mean of one second, std at 25 C [V]."""
    model_j: float = 27e3
    """Activation energy with which it grows in the cold [J/mol]."""
    bias_relative: float = 0.03
    """B: error of the model that stays, relative to the sum of the resistances times the RMS current of 10 min."""
    bias_grown: float = 0.11
    """B: the same by which resistances have grown, in the cold and near empty, beyond those at 25 C and SOC 0.5."""
    bias_soc: float = 0.035
    """B: the same from a shift of resistances and of the OCV's last fall along SOC, at 25 C; it grows with ``WEAK_J``."""
    slow_s: float = 3600.0
    fast_s: float = 45.0
    """B: time constant of the fast bias, in which half of its variance changes [s]."""
    x_relative: float = 0.05
    """Q: current in the branches, relative to the current."""
    charge_error: float = 0.002
    """Q: std of SOC gained over the whole range: linearity of the current sensor."""
    r_std: float = 0.1
    """Resistances: std of their logarithm, if the cell file has none."""
    unsensed_s: float = 3600.0
    """Time constant with which resistances follow an unknown temperature without a sensor [s]."""
    offset_c: float = 0.007
    """Offset of the current sensor, std [C] ..."""
    offset_s: float = 10.0 * 86400.0
    """Time in which the offset drifts by its initial std [s]."""
    zero_std_c: float = 0.001
    """Offset of a sensor that has shown no current at rest, std [C]."""
    capacity_std: float = 0.08
    """Capacity, relative std, ..."""
    aged_soc: float = 1000.0
    """Charge throughput in which the capacity changes by its initial std with age: 500 full cycles [SOC]."""
    cell_spread: float = 0.1
    """Cells in series: by how much of the charge drawn the emptiest lies below their mean, std of SOC. One that is smaller by a
    fifth is within two of it."""
    soc_std: float = 0.2
    """SOC at switch-on, std."""
    load_c: float = 1.2
    """Load before switch-on, unknown: its std [C] ..."""
    load_mean_c: float = 0.3
    """Mean of the unknown load before switch-on [C]."""
    load_level_c: float = 0.35
    """Std of the part of that load that stays constant for hours [C]."""
    load_s: float = 20.0
    """Correlation time of the varying part of that load [s]."""
    half_likelihood_exponent: float = 0.17
    """Power of the likelihood, halved, by which hypotheses are weighted: successive errors are not independent."""
    min_innovation_scale: float = 0.25
    """Minimum fraction to which S shrinks for weights, because R and B allow for the worst case."""
    inconsistency_penalty: float = 0.1
    """A hypothesis that holds the model for wrong by more than two std loses this part of their square from its ln weight, with each
    update."""
    hysteresis_soc: float = 0.04
    """Charge that leads from one branch of the hysteresis to the other [SOC]."""


EKF_SETTINGS = np.dtype(
    [
        ("capacity_as", "f8"),  # declared [A s]
        ("series", "f8"),  # cells in series
        ("ocv_v", "f8", OCV_POINTS),  # E_o over SOC 0..1 at 25 C [V]
        ("ocv_slope_v", "f8", OCV_POINTS),  # dE_o/dSOC [V]
        ("curve_error_v", "f8", GRID),  # std of E_o [V]
        ("learned", "f8"),  # part of its variance that is of the curve, the same each time: ``ocv_correction``
        ("curve_soc", "f8", GRID),  # charge over which that error changes [SOC]
        ("per_kelvin_v", "f8", GRID),  # dE_o/dT [V/K]
        ("hysteresis_v", "f8", GRID),  # half of what E_o is higher after charge than after discharge, at 25 C [V]
        ("weak_ohm", "f8", (GRID, RESISTANCES)),  # at 25 C, activation energy WEAK_J [ohm]
        ("strong_ohm", "f8", (GRID, RESISTANCES)),  # the same with STRONG_J
        ("middle_ohm", "f8"),  # sum of all at SOC 0.5 and 25 C [ohm]
        ("low_c", "f8"),  # temperatures that the resistances are known for [C]
        ("high_c", "f8"),
        ("sensor_v2", "f8"),  # variance of one voltage sample: noise and rounding [V^2]
        ("unmeasured_s", "f8"),  # longest step over which the current counts as measured [s]
        ("current_step_a", "f8"),  # of the current that is shown [A]; 0: none
        ("dead_band_a", "f8"),  # a smaller one is shown as 0 [A]
        *[(field.name, "f8") for field in fields(Noise)],  # volts as of the pack
    ],
    align=True,
)

WINDOW = np.dtype(
    [
        ("samples", "i8"),
        ("time_s", "f8"),  # since the update before [s]
        ("charge_as", "f8"),  # moved since then [A s]
        ("throughput_as", "f8"),  # its magnitude
        ("unknown_as", "f8"),  # std of the charge in unmeasured gaps [A s]
        ("between_as2", "f8"),  # variance of the charge that samples far apart do not show [A^2 s^2]
        ("rounded_as2", "f8"),  # the same of what the steps of the current leave out [A^2 s^2]
        ("gap", "i8"),  # 1: samples are missing
        ("sum_v", "f8"),
        ("sum_a", "f8"),
        ("sum_as", "f8"),  # of the charge moved until each sample
        ("sum_x_a", "f8", BRANCHES),
    ],
    align=True,
)
"""Samples between two updates of the filter."""

STEP = np.dtype(
    [
        ("phase", "i8"),  # of step_resistance
        ("current_a", "f8"),  # when it was last held,
        ("voltage_v", "f8"),
        ("x_a", "f8", BRANCHES),  # and in the branches
        ("ln_ratio", "f8"),  # ln(R_s / R_0 of the file)
        ("variance", "f8"),  # of that
    ],
    align=True,
)
"""Last step of the current, and R_s as learned from such steps."""

EKF_STATE = np.dtype(
    [
        ("mean", "f8", (HYPOTHESES, STATES)),
        ("covariance", "f8", (HYPOTHESES, STATES, STATES)),
        ("ln_weight", "f8", HYPOTHESES),  # of the best 0
        ("minute_u", "f8", HYPOTHESES),  # running means of the normalised innovation, over a minute ...
        ("ten_minutes_u", "f8", HYPOTHESES),  # ... and ten
        ("fast_inflation", "f8", HYPOTHESES),  # of the variance of B_FAST
        ("slow_inflation", "f8", HYPOTHESES),  # of the variance of B_SLOW
        ("count", "i8"),  # hypotheses in use
        ("best", "i8"),  # the likeliest
        ("started", "i8"),
        ("seeded_s", "f8"),  # age of the hypotheses [s]
        ("reopened", "i8"),  # times the SOC became unknown: the model would have to be wrong by too much
        ("window", WINDOW),
        ("current_a", "f8"),  # of the last sample
        ("same_s", "f8"),  # time for which the reported current has been constant to a step [s]
        ("rest_s", "f8"),  # time for which no load has been reported [s]
        ("rest_as", "f8"),  # ... and the charge that was shown all the same [A s]
        ("smallest_a", "f8"),  # the smallest that was shown and is not 0 [A]; 0: none yet
        ("step", STEP),
        ("x_a", "f8", BRANCHES),  # current filtered by the branches since switch-on [A]
        ("decay", "f8", BRANCHES),  # of the branches over ``decay_s``
        ("decay_s", "f8"),
        ("mean_a", "f8"),  # of the current, and ...
        ("rms_a2", "f8"),  # ... of its square, over 10 min [A^2]
        ("usual_a", "f8"),  # the same over hours
        ("usual_a2", "f8"),
        ("temperature_c", "f8"),
        ("weak", "f8"),  # Arrhenius factors at it
        ("strong", "f8"),
        ("hysteresis", "f8"),  # the same of the hysteresis
        ("sensed", "i8"),  # 1: a temperature was reported
        ("soc", "f8"),  # mean of the hypotheses
        ("soc_std", "f8"),
        ("voltage_v", "f8"),  # predicted by the likeliest [V]
        ("innovation_v", "f8"),  # measured less that [V]
        ("innovation_variance", "f8"),  # S [V^2]
        ("ohm", "f8", RESISTANCES),  # scratch: resistances,
        ("h", "f8", STATES),  # H,
        ("ph", "f8", STATES),  # P H',
        ("f", "f8", STATES),  # diagonal of F over the window
    ],
    align=True,
)
