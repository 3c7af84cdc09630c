"""State vector, noise settings and records of the extended Kalman filter.

Order of the state vector and of the covariance:

====  =========  ==============================================================================================
  0   SOC        state of charge z
1-6   X          part of the RC pairs' filtered currents x_k that is due to the load before switch-on [A]
  7   LN_R0      ln of the true over the file's series resistance
  8   LN_R       ln of the true over the file's resistances of the RC pairs, one scale for all
  9   B_SLOW     error of the model that persists for hours [V]
 10   B_FAST     error of the model that persists for a minute [V]
 11   OFFSET     measured less true current [A]
 12   LN_Q       ln(true / declared capacity), not distinguishable from a gain error of the current sensor
 13   HYST       hysteresis h, -1 after discharge, 1 after charge
 14   CURVE      varying error of the OCV at the present SOC, in units of its standard deviation
15-   NODE       constant error of the OCV curve at ``NODES`` SOCs from 0 to 1, in units of its std (``ocv_correction``)
====  =========  ==============================================================================================

Several filters run in parallel from different SOCs until they agree (``hypotheses``).
"""

from dataclasses import dataclass, fields

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, RESISTANCES

SOC, X = 0, 1
"""Index of the SOC, and first index of the RC pairs' currents, in the state vector."""
LN_R0, LN_R, B_SLOW, B_FAST, OFFSET, LN_Q, HYST, CURVE = range(X + BRANCHES, X + BRANCHES + 8)
NODE, NODES = CURVE + 1, 21
"""First index of the OCV nodes in the state vector, and number of these nodes."""
STATES = NODE + NODES
"""Number of states."""
HYPOTHESES = 7
"""Maximum number of hypotheses."""


@dataclass(frozen=True)
class Noise:
    """Uncertainties of one cell, the values of Q, R and P(0) of the filter.

    A C-rate is the current relative to the current that empties the cell in an hour.
    """

    model_v: float = 0.05
    """R: std of the ladder's error in the mean voltage of one second at 25 C [V]."""
    model_j: float = 27e3
    """R: activation energy of the growth of ``model_v`` in the cold [J/mol]."""
    bias_relative: float = 0.03
    """Bias: std relative to the sum of the resistances times the RMS current of 10 min."""
    bias_grown: float = 0.11
    """Bias: std relative to the increase of the resistances over their values at 25 C and SOC 0.5, in the cold and near empty."""
    bias_soc: float = 0.035
    """Bias: std of a shift along SOC, of the resistances and of the OCV's knee near empty, at 25 C. It grows in the cold with the
    Arrhenius factor of ``LOW_ACTIVATION_ENERGY``."""
    slow_s: float = 3600.0
    """Bias: time constant of B_SLOW, which has half of the variance [s]."""
    fast_s: float = 45.0
    """Bias: time constant of B_FAST, which has half of the variance [s]."""
    x_relative: float = 0.05
    """Q: std of the filtered currents of the RC pairs, relative to the current."""
    charge_error: float = 0.002
    """Q: std of the SOC after a throughput of 1, due to the nonlinearity of the current sensor."""
    r_std: float = 0.1
    """P(0): std of ln of the resistances if the cell file declares none."""
    unsensed_s: float = 3600.0
    """Q: time constant of the resistances' changes with an unmeasured temperature [s]."""
    offset_c: float = 0.007
    """P(0): std of the current sensor's offset, as a C-rate."""
    offset_s: float = 10.0 * 86400.0
    """Q: time in which the offset drifts by its initial std [s]."""
    zero_std_c: float = 0.001
    """Std of the offset of a sensor that reports no current at rest, as a C-rate."""
    capacity_std: float = 0.08
    """P(0): relative std of the capacity."""
    aged_soc: float = 1000.0
    """Q: charge throughput over which aging changes the capacity by its initial std [SOC]: 500 full cycles."""
    cell_spread: float = 0.1
    """Cell imbalance: std of the weakest cell's SOC below the mean, per unit of SOC discharged. A cell with 20 % less
    capacity lies at 2 std."""
    soc_std: float = 0.2
    """P(0): std of the SOC at switch-on."""
    load_c: float = 1.2
    """P(0): std of the varying part of the unknown load before switch-on, as a C-rate."""
    load_mean_c: float = 0.3
    """P(0): mean of the unknown load before switch-on, as a C-rate."""
    load_level_c: float = 0.35
    """P(0): std of the part of the unknown load that is constant for hours, as a C-rate."""
    load_s: float = 20.0
    """P(0): correlation time of the varying part of the unknown load [s]."""
    learning_soc: float = 1.0
    """Charge throughput after switch-on in which the filter learns LN_Q and the OCV nodes [SOC]: one pass of the curve. Then
    voltages do not change them, but their errors still count in the std of the SOC. The filter linearizes each pass about
    another estimate. In a second pass it would take the same errors of the curve for new information, and its std would
    decrease while the error remains. A first gap also ends the learning, unless this throughput is infinite."""
    event_probability: float = 0.5
    """P(0): probability that a long gap hides a charge, a discharge or an exchange of the pack, so that any SOC is possible.
    The odds are even, because nothing is known about the gap."""
    event_s: float = 3600.0
    """P(0): time constant with which this probability grows with the duration of the gap [s], of the order of a charge."""
    half_likelihood_exponent: float = 0.17
    """Half of the likelihood's exponent in the weights of hypotheses. It is below 0.5, because successive errors are not
    independent."""
    min_innovation_scale: float = 0.25
    """Minimum factor on S in the weights of hypotheses, because R and the biases cover the worst case."""
    inconsistency_penalty: float = 0.1
    """Log-weight penalty. At each update a hypothesis whose bias exceeds 2 std loses this factor times the excess of the
    squared bias in variances."""
    hysteresis_soc: float = 0.04
    """Charge constant of the exponential approach of h to -1 or 1 [SOC]."""


EKF_SETTINGS = np.dtype(
    [
        ("capacity_as", "f8"),  # declared [A s]
        ("series", "f8"),  # cells in series
        ("ocv_v", "f8", OCV_POINTS),  # E_o over SOC 0..1 at 25 C [V]
        ("ocv_slope_v", "f8", OCV_POINTS),  # dE_o/dSOC [V]
        ("curve_error_v", "f8", GRID),  # std of E_o, including the voltage sensor's gain [V]
        ("voltage_gain_std", "f8"),  # relative std of the voltage sensor's gain
        ("constant_error_v", "f8", GRID),  # part of this std that is equal in each pass: ``ocv_correction`` [V]
        ("varying_error_v", "f8", GRID),  # remaining part, CURVE [V]
        ("node_correlation", "f8"),  # prior correlation of the constant errors at two neighboring nodes
        ("curve_soc", "f8", GRID),  # charge throughput over which the varying error of E_o changes [SOC]
        ("per_kelvin_v", "f8", GRID),  # dE_o/dT [V/K]
        ("hysteresis_v", "f8", GRID),  # half of E_o after charge less E_o after discharge, at 25 C [V]
        # parts of the resistances with LOW_ACTIVATION_ENERGY and with HIGH_ACTIVATION_ENERGY, at 25 C [ohm]
        ("weak_ohm", "f8", (GRID, RESISTANCES)),
        ("strong_ohm", "f8", (GRID, RESISTANCES)),
        ("middle_ohm", "f8"),  # sum of all resistances at SOC 0.5 and 25 C [ohm]
        ("low_c", "f8"),  # temperature range of the resistances, lower end [C]
        ("high_c", "f8"),  # temperature range of the resistances, upper end [C]
        ("min_soc_std", "f8"),  # minimum std of the published SOC
        ("sensor_v2", "f8"),  # variance of one voltage sample: noise and rounding [V^2]
        ("unmeasured_s", "f8"),  # longest step over which the current counts as measured [s]
        ("current_step_a", "f8"),  # resolution of the reported current [A]; 0: not rounded
        ("dead_band_a", "f8"),  # current below which the sensor reports 0 [A]
        *[(field.name, "f8") for field in fields(Noise)],  # voltages are of the whole pack
    ],
    align=True,
)
"""Settings of the Kalman filter."""

WINDOW = np.dtype(
    [
        ("samples", "i8"),
        ("time_s", "f8"),  # time since the previous update [s]
        ("charge_as", "f8"),  # charge since the previous update, positive on discharge [A s]
        ("throughput_as", "f8"),  # sum of charge and discharge since the previous update [A s]
        ("unknown_as", "f8"),  # std of the charge in unmeasured gaps [A s]
        ("between_as2", "f8"),  # variance of the charge between samples far apart [A^2 s^2]
        ("rounded_as2", "f8"),  # variance of the charge due to rounding of the current [A^2 s^2]
        ("skew_a2", "f8"),  # sum over the samples of the variance of their interpolated currents [A^2]
        ("gap", "i8"),  # 1: samples are missing; 2: the gap may hide a charge or an exchange of the pack
        ("sum_v", "f8"),
        ("sum_a", "f8"),
        ("sum_as", "f8"),  # sum over the samples of the charge up to each sample
        ("sum_x_a", "f8", BRANCHES),
    ],
    align=True,
)
"""Samples between two updates of the filter."""

STEP = np.dtype(
    [
        ("phase", "i8"),  # VARYING, CONSTANT or STEPPED of detect_current_step
        ("current_a", "f8"),  # last constant current [A]
        ("voltage_v", "f8"),  # voltage at that current [V]
        ("x_a", "f8", BRANCHES),  # filtered currents of the RC pairs at that time [A]
        ("ln_ratio", "f8"),  # ln(R_s / R_0 of the file)
        ("variance", "f8"),  # variance of ln_ratio
    ],
    align=True,
)
"""Last current step, and R_s learned from such steps."""

EKF_STATE = np.dtype(
    [
        ("mean", "f8", (HYPOTHESES, STATES)),
        ("covariance", "f8", (HYPOTHESES, STATES, STATES)),
        ("ln_weight", "f8", HYPOTHESES),  # log-weights; the best hypothesis has 0 after merging
        ("minute_u", "f8", HYPOTHESES),  # running mean of the normalized innovation over a minute
        ("ten_minutes_u", "f8", HYPOTHESES),  # running mean of the normalized innovation over ten minutes
        ("fast_inflation", "f8", HYPOTHESES),  # factor on the variance of B_FAST
        ("slow_inflation", "f8", HYPOTHESES),  # factor on the variance of B_SLOW
        ("count", "i8"),  # number of hypotheses
        ("best", "i8"),  # index of the most likely hypothesis
        ("started", "i8"),  # 1: initialized
        ("seeded_s", "f8"),  # time since the hypotheses were initialized [s]
        ("reopened", "i8"),  # number of re-initializations of the SOC because of an implausible bias
        ("learned_soc", "f8"),  # charge throughput with LN_Q and OCV nodes learned, up to ``learning_soc`` [SOC]
        ("gap_s", "f8"),  # duration of the last gap that may hide a charge [s]; 0: none
        ("soc_before", "f8"),  # SOC before this gap, less the charge counted since it
        ("std_before", "f8"),  # std of the SOC before this gap
        ("exchanged", "i8"),  # 1: SOC or voltages after this gap show another pack
        ("window", WINDOW),
        ("current_a", "f8"),  # current of the last sample [A]
        ("same_s", "f8"),  # time for which the reported current has been constant within its resolution [s]
        ("rest_s", "f8"),  # duration of the present rest [s]
        ("rest_as", "f8"),  # charge counted in the present rest [A s]
        ("smallest_a", "f8"),  # smallest nonzero reported current [A]; 0: none yet
        ("step", STEP),
        ("x_a", "f8", BRANCHES),  # current since switch-on, filtered by the RC pairs [A]
        ("decay", "f8", BRANCHES),  # decay of the RC pairs over ``decay_s``
        ("decay_s", "f8"),
        ("mean_a", "f8"),  # mean current over 10 min [A]
        ("rms_a2", "f8"),  # mean square of the current over 10 min, not its root [A^2]
        ("usual_a", "f8"),  # mean current over hours [A]
        ("usual_a2", "f8"),  # mean squared current over hours [A^2]
        ("temperature_c", "f8"),  # temperature of the cell, measured or modelled [C]
        ("weak", "f8"),  # Arrhenius factor of LOW_ACTIVATION_ENERGY at that temperature
        ("strong", "f8"),  # Arrhenius factor of HIGH_ACTIVATION_ENERGY
        ("hysteresis", "f8"),  # Arrhenius factor of HYSTERESIS_ACTIVATION_ENERGY
        ("sensed", "i8"),  # 1: a temperature was reported
        ("soc", "f8"),  # mean SOC of the mixture
        ("soc_std", "f8"),  # std of the SOC of the mixture
        ("voltage_v", "f8"),  # voltage predicted by the most likely hypothesis [V]
        ("innovation_v", "f8"),  # measured less predicted voltage [V]
        ("innovation_variance", "f8"),  # S [V^2]
        ("ohm", "f8", RESISTANCES),  # SCRATCH: resistances [ohm]
        ("h", "f8", STATES),  # SCRATCH: H
        ("ph", "f8", STATES),  # SCRATCH: P H'
        ("f", "f8", STATES),  # SCRATCH: diagonal of F over the window
    ],
    align=True,
)
"""State of the Kalman filter."""

SCRATCH = ["ohm", "h", "ph", "f"]
"""Fields of EKF_STATE that are written before each use. Saved states have zeros instead."""
