"""Settings and state records of the observer and of its learning law.

A state record contains all values that a step changes. A checkpoint stores it, and tests compare it bit by bit.
Numbers in parentheses are equations of the thesis. Errata are listed in docs/theory/thesis.md.
"""

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS, PARAMETERS
from bms_estimator.kernels.observer.mittag_leffler import SERIES_TERMS, TABLE_POINTS

OBSERVER_SETTINGS = np.dtype(
    [
        ("capacity_as", "f8"),  # C_c of (2.1) [A s]; 0: a fuel cell, which holds no charge
        ("ocv_v", "f8", OCV_POINTS),  # E_o over SOC 0..1 [V]
        ("ocv_slope_v", "f8", OCV_POINTS),  # dE_o/dSOC [V]
        ("a_initial", "f8", PARAMETERS),  # a_i(t0)
        # value that a_i approaches by (3.18): mean of its upper bound au with weight lx and its lower bound al with weight ly
        ("target", "f8", PARAMETERS),
        ("rate", "f8", PARAMETERS),  # rate of that approach: lx + ly of (3.18), lambda of (3.17) [1/s]
        ("drive", "f8", PARAMETERS),  # 1: e^2 drives the parameter; 0: the parameter is constant
        ("output_r_s", "f8"),  # 1: the output contains the ohmic drop u R_s (3.14); 0: it does not (4.1)
        ("nussbaum", "i8"),  # kernels.observer.observer.Nussbaum
        ("alpha", "f8"),  # a of (3.10), in (2, 3]
        ("gain_scale", "f8"),  # lambda^(1/a) of (3.10) [1/(V^2 s)]
        ("ml_series", "f8", SERIES_TERMS),  # ``mittag_leffler.series_coefficients`` for alpha
        ("ml_decay", "f8", TABLE_POINTS),  # first table of ``mittag_leffler.decay_table`` for alpha
        ("ml_decay_slope", "f8", TABLE_POINTS),  # second table of ``decay_table``
        ("k0", "f8"),  # k(t0) [V^2 s]
        ("gain_limit", "f8"),  # clamp of |N|
        # In lock, k is reset to k0 when N(k) falls below ``rearm_gain``, so that the gain does not become negative. No reset
        # occurs if it is -inf, or if it is at least N(k0), because the reset would not raise the gain above it.
        ("rearm_gain", "f8"),
        ("dead_zone_v", "f8"),  # e_dead of erratum 2 [V]; 0 gives the printed (3.13)
        ("epsilon_v", "f8"),  # eps2 of Algorithm 1: |e| below which an estimate counts as converged [V]
        ("lock_error_v", "f8"),  # |e| beyond which the observer does not track [V]
        ("lock_time_s", "f8"),  # time with |e| beyond or within lock_error_v until the lock is lost or regained [s]
        ("margin_guard", "f8"),  # SOC distance above max(delta1, delta2) at which adaptation stops
        ("soc_initial", "f8"),  # 0..1; NaN: from the first sample's voltage through the OCV
        ("voltage_min_v", "f8"),  # minimum voltage of an accepted sample [V]
        ("voltage_max_v", "f8"),  # maximum voltage of an accepted sample [V]
        ("current_max_a", "f8"),  # maximum magnitude of the current of an accepted sample [A]
        ("check_ohm", "f8"),  # series resistance of the cell file at SOC 0.5, for ``kernels.current_check`` [ohm]
        ("check_slow_ohm", "f8"),  # resistance of the RC pairs of the cell file at SOC 0.5, for this check [ohm]
        ("check_v", "f8"),  # ohmic drop up to which a change of the current is not checked [V]
        # A longer step is a gap, unless it is at most GAP_RATIO times the previous step [s]
        ("gap_s", "f8"),
        ("unmeasured_s", "f8"),  # longest step over which the current is interpolated between samples [s]
    ],
    align=True,
)

OBSERVER_STATE = np.dtype(
    [
        ("time_s", "f8"),  # time stamp of the last accepted sample [s]
        ("current_a", "f8"),  # current of the last accepted sample [A]
        ("step_s", "f8"),  # time between the last two accepted samples [s]
        ("voltage_age_s", "f8"),  # age of the last measured voltage at the last accepted sample [s]
        ("soc", "f8"),  # x1, 0..1: from the identifier, or by coulomb counting
        ("soc_coulomb", "f8"),  # by coulomb counting alone (3.1), 0..1
        ("v_ts", "f8"),  # x2 [V]
        ("v_tl", "f8"),  # x3 [V]
        ("k", "f8"),  # adaptive gain state (3.13) [V^2 s]
        ("gain", "f8"),  # N(k) of a Nussbaum law, or gamma k of the learning law [1/s]
        ("a", "f8", PARAMETERS),  # a1..a15 (3.16)-(3.18)
        ("target", "f8", PARAMETERS),  # value that a_i approaches by (3.18); the identifier changes it
        ("decay", "f8", PARAMETERS),  # e^(-rate dt) for ``decay_dt_s``
        ("settle", "f8", PARAMETERS),  # (1 - decay) / rate for ``decay_dt_s`` [s]
        ("decay_dt_s", "f8"),
        ("innovation_v", "f8"),  # e = y - y^ before the sample corrected the states (3.15)
        ("voltage_estimate_v", "f8"),  # y^ after the sample corrected the states (4.1)
        ("delta_1", "f8"),  # SOC below which C_ts of the model is negative (2.11)
        ("delta_2", "f8"),  # SOC below which C_tl of the model is negative (2.12)
        ("unlocked_s", "f8"),  # in lock: time with |e| beyond lock_error_v; otherwise: time with |e| within it [s]
        ("started", "i8"),  # 1: initialized by a first sample
        ("lock", "i8"),  # 1 while the observer tracks
        ("adapting", "i8"),  # 1 while the parameters adapt; 0 at an SOC below the stability floor
        ("samples", "i8"),  # number of accepted samples
        ("dropped_not_finite", "i8"),
        ("dropped_range", "i8"),
        ("dropped_repeated", "i8"),  # samples with the time stamp of the previous one
        ("dropped_saturated", "i8"),  # voltage or current at the end of the converter's range
        ("dropped_contradicted", "i8"),  # samples with a current that the voltage does not follow
        ("time_steps_back", "i8"),  # number of samples at which the clock was set back; the step to them is discarded
        ("gaps", "i8"),  # number of gaps (``kernels.step.is_gap``)
        ("lock_losses", "i8"),  # number of times that the lock was lost
        ("gain_rearms", "i8"),  # number of resets of k before the gain changed its sign
    ],
    align=True,
)
"""State of the observer."""

LEARNABLE = 8
"""Maximum number of identified parameters of a model."""
CONSTANTS = 16
"""Maximum number of constants from a model's file; Chen & Mora: a1..a15 at their index."""

LEARNING_SETTINGS = np.dtype(
    [
        ("enabled", "i8"),  # 0: an adaptive law of the thesis is used instead
        ("model", "i8"),  # kernels.observer.learning_law.Model
        ("count", "i8"),  # number of identified parameters
        ("file", "f8", CONSTANTS),  # parameters of the cell file, which theta = 0 denotes
        ("lower", "f8", LEARNABLE),  # bounds of theta
        ("upper", "f8", LEARNABLE),
        ("middle", "f8", LEARNABLE),  # theta that the leakage approaches
        ("leak_v2s", "f8", LEARNABLE),  # weight of the leakage, as information [V^2 s]
        ("memory_s", "f8"),  # time constant with which data are discounted under load [s]
        ("offset_s", "f8"),  # time constant with which the output error is added to the offset [s]; infinite: never
        ("settle_s", "f8"),  # time after which effects of unknown initial states have decayed [s]
        ("rate", "f8"),  # gamma: rate at which theta follows the data, at k = 1 [1/s]
        ("cells", "f8"),  # cells in series; k grows with the error of one cell
        ("told_v", "f8"),  # norm of psi above which the data count as informative [V]
        ("reach", "f8"),  # trust region of theta: maximum step for which the sensitivities are valid
        ("soc_floor", "f8"),  # SOC below which learning is disabled (erratum 14)
    ],
    align=True,
)
"""Settings of the learning law."""

LEARNING_STATE = np.dtype(
    [
        ("theta", "f8", LEARNABLE),  # logarithm of each parameter over the file's value
        ("x", "f8", 2),  # states of the model [V]
        ("dx", "f8", (2, LEARNABLE)),  # derivatives of the states by theta [V]
        ("offset_v", "f8"),  # injected offset of the output [V]
        ("d_offset", "f8", LEARNABLE),  # derivative of offset_v by theta [V]
        ("psi", "f8", LEARNABLE),  # dy^/dtheta [V]
        ("temperature_c", "f8"),  # last reported value; NaN without one [C]
        ("given", "f8", LEARNABLE),  # constants of the model at the last sample
        ("information", "f8", (LEARNABLE, LEARNABLE)),  # discounted integral of psi psi' [V^2 s]
        ("pull", "f8", LEARNABLE),  # discounted integral of psi (e + psi' theta) [V^2 s]
        ("settle_s", "f8"),  # remaining time without learning, while the states depend on an unmeasured load [s]
        ("waited_s", "f8"),  # time since the last step of theta [s]
        ("step", "f8", LEARNABLE),  # last change of theta
        ("factor", "f8", (LEARNABLE, LEARNABLE)),  # Cholesky factor of information plus leakage
    ],
    align=True,
)
"""State of the learning law."""
