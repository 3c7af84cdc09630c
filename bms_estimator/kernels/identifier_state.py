"""Records of the identifier: its state vector, its settings, and where each setting's value comes from.

The state vector, in this order (also the order of rows and columns of the covariance):

====  ====================  ==========================================================================
  0   SOC                   state of charge
  1   V_TS                  voltage over R_ts || C_ts [V]
  2   V_TL                  voltage over R_tl || C_tl [V]
  3   LN_R_S                ln(R_s / ohm)
  4   LN_R_TS               ln(R_ts / ohm)
  5   LN_TAU_TS             ln(R_ts C_ts / s)
  6   LN_R_TL               ln(R_tl / ohm)
  7   LN_TAU_TL             ln(R_tl C_tl / s)
  8   OCV_ERROR             error of the OCV curve at this SOC, in units of its expected size
  9   V_SLOW                voltage of diffusion that is slower than both branches [V]
 10   CURRENT_OFFSET        measured less true current [A]; optional
 11   LN_CAPACITY           ln(true / declared capacity); optional
====  ====================  ==========================================================================
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell import OCV_POINTS, Floats

STATES = 12
SOC, V_TS, V_TL, LN_R_S, LN_R_TS, LN_TAU_TS, LN_R_TL, LN_TAU_TL = range(8)
OCV_ERROR, V_SLOW, CURRENT_OFFSET, LN_CAPACITY = range(8, STATES)
ELEMENTS = 5
"""LN_R_S .. LN_TAU_TL."""
CORRELATED = 0.01
"""Share of the predicted variance that neighbouring innovations have in common when the model's error is as told."""
LEAST_MISFIT = 0.001
"""A model's error is never less than 3 % of what the tuning says."""

IDENTIFIER_SETTINGS = np.dtype(
    [
        ("capacity_as", "f8"),  # declared capacity [A s]
        ("ocv_v", "f8", OCV_POINTS),  # E_o over SOC 0..1 [V]
        ("ocv_slope_v", "f8", OCV_POINTS),  # dE_o/dSOC [V]
        ("active", "i8"),  # states in use: 10, 11 with the current offset, 12 with the capacity as well
        ("mean", "f8", STATES),  # at the first sample
        ("variance", "f8", STATES),  # at the first sample
        ("lower", "f8", STATES),  # the mean stays within
        ("upper", "f8", STATES),
        ("variance_floor", "f8", STATES),
        ("variance_ceiling", "f8", STATES),
        ("drift_per_s", "f8", STATES),  # growth of the variance with time [1/s], where the load excites
        ("drift_per_soc", "f8", STATES),  # growth of the variance with charge moved, per unit of SOC
        ("noise_v2", "f8"),  # sensor noise, white [V^2]
        ("rounding_v2", "f8"),  # rounding of the converter [V^2]; the same from sample to sample within 1 s
        ("model_v2", "f8"),  # error of the two-branch model [V^2]
        ("model_s", "f8"),  # its correlation time [s]
        ("ohmic_relative", "f8"),  # error of R_s i, relative: R_s is not quite linear
        ("ohmic_step", "f8"),  # error of R_s times a change of current, relative
        ("branch_v2", "f8"),  # stationary variance of what each branch leaves out, at rest [V^2]
        ("branch_relative", "f8"),  # the same under load, relative to R i
        ("slow_s", "f8"),  # time constant of diffusion slower than both branches [s]
        ("slow_mean", "f8"),  # its resistance, as a part of R_ts + R_tl
        ("slow_relative", "f8"),  # what that is wrong by, relative to R_ts + R_tl
        ("timing", "f8"),  # when within a sample interval the current changed, std as a fraction of it
        ("curvature", "f8"),  # weight of the second-order terms that linearising leaves out
        ("curvature_s", "f8"),  # their correlation time [s]
        ("ocv_error_v", "f8"),  # std of the OCV curve's error in voltage [V]
        ("ocv_error_soc", "f8"),  # std of the OCV curve's error along SOC
        ("capacity_spread", "f8"),  # what is added to it at SOC 0: captures are anchored at full
        ("ocv_error_length", "f8"),  # SOC over which the curve's error changes
        ("hysteresis_charge_v", "f8"),  # offset of the OCV after charge from that after discharge, the grid's [V]
        ("hysteresis_soc", "f8"),  # charge that leads from one branch to the other, per unit of SOC
        ("hysteresis_error_v", "f8"),  # std of the OCV after charge, beyond ocv_error_v [V]
        ("hysteresis_error_length", "f8"),  # SOC over which that changes
        ("excited_v", "f8"),  # a parameter whose effect on the voltage is below this is hardly excited [V]
        ("misfit_s", "f8"),  # memory of the model's error, counted while the branches are out of balance [s]
        ("surprise_s", "f8"),  # memory of the squared normalised innovation that widens the drift [s]
        ("surprise_gain", "f8"),
        ("surprise_limit", "f8"),
        ("gate", "f8"),  # squared normalised innovation beyond which a sample is not believed
        ("gate_samples", "i8"),  # as many in a row, ...
        ("gate_s", "f8"),  # ... lasting as long [s], and the world has changed, not the sample
        ("idle_current_a", "f8"),  # std of a current that nobody measured [A]
        ("tau_ratio", "f8"),  # least ln(tau_tl / tau_ts)
        ("bias_s", "f8"),  # memory of offset and capacity [s]
        ("snapshot_s", "f8"),  # how often the state is kept as the last good one [s]
    ],
    align=True,
)

IDENTIFIER_STATE = np.dtype(
    [
        ("mean", "f8", STATES),
        ("covariance", "f8", (STATES, STATES)),
        ("gain", "f8", STATES),  # K of the last sample
        ("projected", "f8", STATES),  # P h of the last sample
        ("current_a", "f8"),  # of the last sample
        ("branch", "f8"),  # 0 after discharge, 1 after charge
        ("tau_ts_effect_v", "f8"),  # dv_ts / d ln(tau_ts) [V]
        ("tau_tl_effect_v", "f8"),  # dv_tl / d ln(tau_tl) [V]
        ("innovation_v", "f8"),  # measured less predicted voltage [V]
        ("innovation_variance", "f8"),  # what it should be [V^2]
        ("voltage_v", "f8"),  # predicted, before the sample corrected the state [V]
        ("surprise", "f8"),  # running mean of the squared normalised innovation
        ("misfit", "f8"),  # size of the model's error as a variance, LEAST_MISFIT..1 of what the settings say
        ("correlated", "f8"),  # running mean of an innovation times the one before, as a share of its variance
        ("believed_v", "f8"),  # the innovation before, 0 when it was not believed [V]
        ("unsettled_v2", "f8"),  # how far the branches are from R i, squared [V^2]
        ("offset_sense", "f8", STATES),  # error of the state by an offset of the current [1/A]
        ("capacity_sense", "f8", STATES),  # the same by ln(true / declared capacity)
        ("offset_information", "f8"),  # of the innovations on the offset [1/A^2]
        ("capacity_information", "f8"),
        ("offset_score", "f8"),  # [1/A]
        ("capacity_score", "f8"),
        ("gated_in_row", "i8"),
        ("gated_s", "f8"),  # how long samples have been gated [s]
        ("good_mean", "f8", STATES),  # last good state
        ("good_covariance", "f8", (STATES, STATES)),
        ("good_age_s", "f8"),
        ("started", "i8"),
        ("gated", "i8"),  # samples not believed
        ("asynchronous", "i8"),  # samples whose voltage was taken before the current had changed
        ("reopened", "i8"),  # so many samples gated in a row that the state was widened
        ("doubted", "i8"),  # the OCV's error became implausible: the SOC was taken from the voltage
        ("reset", "i8"),  # not finite: back to the last good state
        ("suspects", "i8"),  # bits of model.suspect.Suspect
        ("slow_v", "f8"),  # voltage and ...
        ("slow_a", "f8"),  # ... current without their fast changes
        ("sign_evidence", "f8"),  # 0..1: how much was seen of
        ("change_v_a", "f8"),  # running mean of the fast change of voltage times that of current [V A]
        ("change_a2", "f8"),  # the same of the current's squared [A^2]
        ("outliers", "f8"),  # single samples not believed of late
        ("breaks", "f8"),  # doubted and reopened of late
        ("seen_gated", "i8"),
        ("seen_asynchronous", "i8"),
        ("seen_doubted", "i8"),
        ("seen_reopened", "i8"),
        ("ignored", "i8"),  # not finite or not later than the sample before
    ],
    align=True,
)

IDENTIFIER_COUNTERS = ("gated", "asynchronous", "reopened", "doubted", "reset", "ignored")
"""Fields of the state that count."""


@dataclass(frozen=True)
class Tuning:
    """What is not known of a cell, in physical terms; for one cell in series.

    The values are of the size that two-branch models of 18650 and 21700 cells show against real captures. Twice or half
    of any of them changes the RMS error of the SOC over all captures by less than 0.15 %: they are no fit to a file.
    """

    soc_std: float = 0.2
    """Initial SOC, std."""
    ln_std: float = math.log(2.0)
    """Initial resistances and time constants: a factor of two either way."""
    branch_std_v: float = 0.01
    """Initial v_ts and v_tl at rest [V]."""
    model_error_v: float = 0.001
    """Error of a two-branch model [V] ..."""
    model_error_s: float = 12.0
    """... which keeps its sign for as long [s]."""
    ohmic_relative: float = 0.02
    ohmic_step: float = 0.05
    branch_error_v: float = 0.001
    """What a branch leaves out at rest [V]: settling is slower than exponential."""
    branch_relative: float = 0.3
    """What a branch leaves out under load, relative to R i."""
    slow_s: float = 1800.0
    """Diffusion goes on for hours where two branches have long settled. What is left out looks like a lower SOC ..."""
    slow_mean: float = 0.2
    """... so a fifth of R_ts + R_tl is expected there, ..."""
    slow_relative: float = 0.2
    """... give or take as much."""
    timing: float = 0.3
    """Uniform over the interval: 1 / sqrt(12)."""
    curvature: float = 0.12
    curvature_s: float = 20.0
    ocv_error_v: float = 0.004
    """Spread of resting voltages from cell to cell of a type [V]."""
    ocv_error_soc: float = 0.007
    """Spread of capacity and of balance of the electrodes from cell to cell of a type."""
    capacity_spread: float = 0.015
    """Relative spread of capacity from cell to cell of a type: the curve's error grows from full to empty."""
    ocv_error_length: float = 0.15
    """Stages of graphite are that wide."""
    hysteresis_charge_v: float = 0.0
    hysteresis_soc: float = 0.05
    hysteresis_error_v: float = 0.045
    """OCV after charge less that after discharge, of a layered-oxide cell [V]."""
    hysteresis_error_length: float = 0.5
    """It keeps its sign over much of the range."""
    r_s_drift_per_h: float = 0.06
    """Std of ln R_s gained in an hour under load: temperature."""
    r_drift_per_h: float = 0.06
    tau_drift_per_h: float = 0.03
    r_s_drift_over_soc: float = 0.14
    """Std of ln R_s gained over the whole SOC range, where (2.9) is flat; near empty the surprise widens it."""
    r_drift_over_soc: float = 0.32
    tau_drift_over_soc: float = 0.22
    charge_error: float = 0.002
    """Std of SOC gained over the whole range: linearity of the current sensor."""
    excited_v: float = 0.003
    misfit_s: float = 200.0
    surprise_s: float = 20.0
    surprise_gain: float = 20.0
    surprise_limit: float = 100.0
    gate_std: float = 5.0
    gate_samples: int = 5
    gate_s: float = 5.0
    tau_ratio: float = 5.0
    """tau_tl is at least so many times tau_ts: 5 to 14 in cells known, and closer ones are one branch to any load."""
    r_span: float = 20.0
    """Resistances stay within this factor of the configured ones."""
    tau_span: float = 6.0
    """Time constants stay within this factor of the configured ones."""
    current_offset_std_a: float = 0.0
    """Initial offset of the current sensor, std [A]; 0 leaves the state out."""
    capacity_std: float = 0.0
    """Initial relative error of the capacity, std; 0 leaves the state out."""
    bias_s: float = 36000.0
    snapshot_s: float = 60.0

    def pack(self, series: int) -> "Tuning":
        """The same for ``series`` cells in series: voltages add up."""
        return replace(
            self,
            branch_std_v=self.branch_std_v * series,
            model_error_v=self.model_error_v * series,
            branch_error_v=self.branch_error_v * series,
            ocv_error_v=self.ocv_error_v * series,
            hysteresis_charge_v=self.hysteresis_charge_v * series,
            hysteresis_error_v=self.hysteresis_error_v * series,
            excited_v=self.excited_v * series,
        )


def identifier_settings(
    capacity_ah: float,
    ocv_v: Floats,
    ocv_slope_v: Floats,
    soc: float,
    elements: tuple[float, float, float, float, float],
    *,
    noise_v: float,
    resolution_v: float,
    tuning: Tuning | None = None,
) -> NDArray[np.void]:
    """The identifier's settings record.

    Args:
        capacity_ah: Declared capacity [Ah].
        ocv_v: Open-circuit voltage at ``OCV_POINTS`` evenly spaced SOCs 0..1 [V].
        ocv_slope_v: Its slope dOCV/dSOC there [V].
        soc: SOC to start from, 0..1.
        elements: R_s [ohm], R_ts [ohm], R_ts C_ts [s], R_tl [ohm], R_tl C_tl [s] to start from.
        noise_v: Noise of the voltage sensor, std [V].
        resolution_v: Step of the voltage converter [V].
        tuning: ``Tuning().pack(series)``; that of one cell when left out.

    Returns:
        Shape (1,), dtype ``IDENTIFIER_SETTINGS``.
    """
    t = tuning or Tuning()
    record = np.zeros(1, dtype=IDENTIFIER_SETTINGS)
    p = record[0]
    p["capacity_as"] = capacity_ah * 3600.0
    p["ocv_v"], p["ocv_slope_v"] = ocv_v, ocv_slope_v
    p["active"] = STATES if t.capacity_std > 0.0 else (11 if t.current_offset_std_a > 0.0 else 10)
    ln = np.log(elements)
    span = np.log([t.r_span, t.r_span, t.tau_span, t.r_span, t.tau_span])
    ln_variance, branch_v2 = t.ln_std**2, t.branch_std_v**2
    offset, capacity = t.current_offset_std_a**2, t.capacity_std**2
    p["mean"] = [soc, 0.0, 0.0, *ln, 0.0, 0.0, 0.0, 0.0]
    p["variance"] = [t.soc_std**2, branch_v2, branch_v2, *[ln_variance] * 5, 1.0, branch_v2, offset, capacity]
    p["lower"] = [-0.02, -np.inf, -np.inf, *(ln - span), -6.0, -np.inf, -np.inf, math.log(0.4)]
    p["upper"] = [1.02, np.inf, np.inf, *(ln + span), 6.0, np.inf, np.inf, math.log(1.3)]
    p["variance_floor"] = [1e-8, 1e-10, 1e-10, *[1e-6] * 5, 1e-4, 0.0, 0.0, 0.0]
    swing = (ocv_v[-1] - ocv_v[0]) ** 2
    p["variance_ceiling"] = [0.09, swing, swing, *[1.0] * 5, 1.0, swing, 4.0 * offset, 4.0 * capacity]
    r_s, r, tau = t.r_s_drift_per_h**2, t.r_drift_per_h**2, t.tau_drift_per_h**2
    p["drift_per_s"] = np.array([0.0, 0.0, 0.0, r_s, r, tau, r, tau, 0.0, 0.0, 0.0, 0.0]) / 3600.0
    r_s, r, tau = t.r_s_drift_over_soc**2, t.r_drift_over_soc**2, t.tau_drift_over_soc**2
    p["drift_per_soc"] = [t.charge_error**2, 0.0, 0.0, r_s, r, tau, r, tau, 0.0, 0.0, 0.0, 0.0]
    p["noise_v2"] = noise_v**2
    p["rounding_v2"] = resolution_v**2 / 12.0
    p["model_v2"], p["model_s"] = t.model_error_v**2, t.model_error_s
    p["branch_v2"] = t.branch_error_v**2
    p["gate"] = t.gate_std**2
    p["idle_current_a"] = capacity_ah / 10.0
    p["tau_ratio"] = math.log(t.tau_ratio)
    for name in _SAME_NAME:
        p[name] = getattr(t, name)
    return record


_SAME_NAME = [
    name for name in IDENTIFIER_SETTINGS.names or () if name in Tuning.__dataclass_fields__ and name != "tau_ratio"
]
