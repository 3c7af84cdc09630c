"""Anchors: ends of charge and of discharge that define SOC 1 and SOC 0 of the pack.

Full: the voltage was at the full voltage for 15 s while the charge current was small, and the charge then ended. A
charge that ends at the full voltage with a large current is not full: its voltage includes the overpotential of that
current. Chargers without a constant-voltage phase and a protection that reacts to one high cell end charges in this way.
The std of this anchor includes the SOC that is missing because of a low voltage, the overpotential and diffusion.
The end of the charge is required, because a slow charge at constant current reaches the lower limit of the full voltage up to
2.5 % of SOC too early. If the charger does not switch off, the pack is full after an hour at the full voltage with less than
the tail current.

Empty: the voltage was below the cut-off voltage under load, and then a protection disconnected the pack. The current is zero
for a minute, or no samples come because the protection also disconnects the electronics. The std of this anchor includes the
overpotential of the load. In the cold and at a high rate the std is too large for an anchor: a Panasonic 18650PF at 0 C
reaches 2.5 V at C/5 with 15 % of its charge left.

An anchor is a direct measurement of the SOC. It corrects neither capacity, offset nor OCV curve, because the same anchor
recurs with each charge, and the filter would count each recurrence as new information on them.

``a`` is a record of ANCHORS, ``p`` of ANCHOR_SETTINGS, ``f`` of EKF_STATE, ``ekf`` of EKF_SETTINGS.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.chen_mora import ocv, soc_from_ocv
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, resistances
from bms_estimator.kernels.kalman_filter.ekf import CHARGE_PAIR, HOLD_CELL, HOLD_OFFSET, apply_correction
from bms_estimator.kernels.kalman_filter.mixture import (
    clear_hypothesis,
    copy_hypothesis,
    mixture_moments,
    prune_and_merge,
    scale_state,
)
from bms_estimator.kernels.kalman_filter.noise import bias_variance
from bms_estimator.kernels.kalman_filter.records import B_FAST, B_SLOW, CURVE, LN_R, LN_R0, SOC, STATES, X
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

NO_ANCHOR, FULL, EMPTY = range(3)
"""Kinds of anchors."""
FULL_STD = 0.01
"""Minimum std of the SOC when full. The end of charge of one charger at one pack repeats within about 1 %."""
LEAD_SOC = 0.05
"""Part of the std of the SOC when full that is caused by diffusion, per C-rate of the charge. The surfaces of the particles are
full before their interiors: after a charge with C/2 to 3.65 V, LFP cells accept another 2 to 3 % at this voltage."""
AT_FULL_S = 15.0
"""Minimum time at the full voltage with a small charge current [s]. With a fast charger, the current of an LFP cell falls from
C/8 to C/20 in 20 s. Regeneration is mostly shorter."""
MAX_AT_FULL_S = 2.0 * AT_FULL_S
"""Limit of the counted time once voltage or current has left its range [s]. The time then counts down, so that a charge which
ends within another 15 s still counts as full."""
FLOAT_S = 3600.0
"""Time at the full voltage after which a charge below the tail current counts as ended [s], because some chargers do not switch
off."""
MAX_COUNTED_S = 0.5 * AT_FULL_S
"""Maximum time that one window counts [s], so that at least two windows show the full voltage."""
MAX_CHARGE_GAP_S = 1800.0
"""Maximum gap in the constant-voltage phase of a charge [s]. Assumed."""
REARM_SOC = 0.02
"""Minimum charge between two anchors of one kind [SOC]. A charger that trickles for days must not cause repeated anchors."""
DISCONNECTED_S = 60.0
"""Time without current after which a protection has ended the discharge [s]. Stops of a vehicle are mostly shorter."""
IDLE_C = 0.02
"""Maximum current of a pack that a protection has disconnected, as a C-rate. It is above the offset of most sensors."""
MAX_EMPTY_STD = 0.05
"""Maximum std of the SOC when empty. It is exceeded below about 10 C, where cells reach the cut-off voltage at a higher SOC than
this std describes."""
MAX_STDS = 3.0
"""Maximum difference between the SOCs of anchor and filter, in std of the difference. Beyond it, the filter's biases have
absorbed a wrong SOC."""

ANCHOR_SETTINGS = np.dtype(
    [
        ("full_v", "f8"),  # minimum terminal voltage at the end of a charge [V]; infinite: no such anchor
        ("charger_v", "f8"),  # nominal voltage of the charger, above full_v by the tolerance [V]
        ("tail_a", "f8"),  # charge current below which a pack at full_v is full [A]
        ("small_a", "f8"),  # maximum charge current at full_v of a charge that ends full [A]
        ("trickle_a", "f8"),  # minimum charge current that distinguishes a charge from the offset of the sensor [A]
        ("corrects_full", "i8"),  # 0: the OCV curve contradicts SOC 1 at full_v, so that the filter is not corrected
        ("cutoff_v", "f8"),  # maximum terminal voltage at the end of a discharge [V]; -infinite: no such anchor
        ("corrects_empty", "i8"),  # 0: the OCV curve contradicts SOC 0 at cutoff_v
    ],
    align=True,
)
"""Settings of the anchors."""

ANCHORS = np.dtype(
    [
        ("at_full_s", "f8"),  # counts up at the full voltage with a small charge current, and down otherwise [s]
        ("full_wait_soc", "f8"),  # charge to be drawn before the next full anchor [SOC]
        ("below_cutoff", "i8"),  # 1: the voltage was below the cut-off voltage under the last load
        ("idle_s", "f8"),  # time without current [s]
        ("empty_wait_soc", "f8"),  # charge to be charged before the next empty anchor [SOC]
        ("full_std", "f8"),  # std of the SOC of the next full anchor
        ("empty_std", "f8"),  # std of the SOC of the next empty anchor
        ("full_anchors", "i8"),  # number of full anchors
        ("empty_anchors", "i8"),  # number of empty anchors
        ("last", "i8"),  # kind of the last anchor
        ("soc_before", "f8"),  # SOC before the last anchor
        ("soc_std_before", "f8"),  # std of the SOC before the last anchor
        ("soc_after", "f8"),  # SOC after the last anchor
    ],
    align=True,
)
"""State of the anchors. All fields are 0 before the first sample."""


@njit(cache=True)
def continue_over_gap(
    a: Record, p: Record, f: Record, ekf: Record, gap_s: float, current_a: float, voltage_v: float
) -> None:
    """Count a charge at the full voltage with a small current at the first sample after a gap, and discard everything else.

    A sparse log has samples some minutes apart in the constant-voltage phase. A pack in this phase before and after the gap was
    in it throughout.
    """
    at_full_s = a.at_full_s if gap_s <= MAX_CHARGE_GAP_S else 0.0
    a.at_full_s = a.idle_s = 0.0
    a.below_cutoff = 0
    if is_charging_at_full(p, f, current_a, voltage_v):
        a.at_full_s = min(at_full_s + MAX_COUNTED_S, MAX_AT_FULL_S)
        a.full_std = full_std(f, ekf, current_a, max(p.charger_v - voltage_v, 0.0))


@njit(cache=True)
def detect_anchor(a: Record, p: Record, f: Record, ekf: Record, dt_s: float, current_a: float, voltage_v: float) -> int:
    """Return the kind of anchor that a window of the filter completes.

    Args:
        a: Record of ANCHORS.
        p: Record of ANCHOR_SETTINGS.
        f: Record of EKF_STATE.
        ekf: Record of EKF_SETTINGS.
        dt_s: Duration of the window [s].
        current_a: Mean current of the window's samples, positive on discharge [A].
        voltage_v: Mean voltage of the window's samples [V].
    """
    if dt_s > ekf.unmeasured_s:
        continue_over_gap(a, p, f, ekf, dt_s, current_a, voltage_v)
        return NO_ANCHOR
    drawn_soc = current_a * dt_s / ekf.capacity_as
    if a.full_wait_soc > 0.0:
        a.full_wait_soc = min(max(a.full_wait_soc - drawn_soc, 0.0), REARM_SOC)
    elif charge_ends_full(a, p, f, ekf, dt_s, current_a, voltage_v):
        a.full_wait_soc, a.at_full_s = REARM_SOC, 0.0
        a.full_anchors += 1
        return FULL
    if a.empty_wait_soc > 0.0:
        a.empty_wait_soc = min(max(a.empty_wait_soc + drawn_soc, 0.0), REARM_SOC)
    elif discharge_ends_empty(a, p, f, ekf, dt_s, current_a, voltage_v):
        a.empty_wait_soc, a.below_cutoff = REARM_SOC, 0
        a.empty_anchors += 1
        return EMPTY
    return NO_ANCHOR


@njit(cache=True)
def charge_ends_full(
    a: Record, p: Record, f: Record, ekf: Record, dt_s: float, current_a: float, voltage_v: float
) -> bool:
    """Return True if the charge has ended after ``AT_FULL_S`` at the full voltage with a small charge current.

    The counted time decreases while voltage or current is outside its limits, so that noise does not restart it.
    """
    was_at_full_s = a.at_full_s
    if is_charging_at_full(p, f, current_a, voltage_v):
        a.at_full_s = min(was_at_full_s + min(dt_s, MAX_COUNTED_S), FLOAT_S)
        a.full_std = full_std(f, ekf, current_a, max(p.charger_v - voltage_v, 0.0))
    else:
        a.at_full_s = max(min(was_at_full_s, MAX_AT_FULL_S) - dt_s, 0.0)
    if was_at_full_s >= AT_FULL_S and current_a > -p.trickle_a:
        return True
    return a.at_full_s >= FLOAT_S and current_a > -p.tail_a


@njit(cache=True)
def is_charging_at_full(p: Record, f: Record, current_a: float, voltage_v: float) -> bool:
    """Return True during a charge at the full voltage with a small current."""
    is_small = -p.small_a <= current_a <= -p.trickle_a
    is_charge = f.x_a[CHARGE_PAIR] <= -p.trickle_a  # averaged over 500 s, which is longer than regeneration
    return voltage_v >= p.full_v and is_small and is_charge


@njit(cache=True)
def discharge_ends_empty(
    a: Record, p: Record, f: Record, ekf: Record, dt_s: float, current_a: float, voltage_v: float
) -> bool:
    """Return True if the current has been zero for a minute since the voltage under load was below the cut-off voltage."""
    idle_a = IDLE_C * ekf.capacity_as / 3600.0
    if abs(current_a) > idle_a:
        a.idle_s = 0.0
        a.below_cutoff = 1 if current_a > 0.0 and voltage_v <= p.cutoff_v else 0
        if a.below_cutoff:
            a.empty_std = empty_std(f, ekf, current_a, p.cutoff_v)
        return False
    a.idle_s += dt_s
    return a.below_cutoff == 1 and a.idle_s >= DISCONNECTED_S and a.empty_std <= MAX_EMPTY_STD


@njit(cache=True)
def gap_begins_empty(a: Record, gap_s: float) -> bool:
    """Return True, and count the anchor, if a gap of ``gap_s`` [s] began at the cut-off voltage under load.

    The protection then disconnected the pack and with it the electronics, so that no samples show the time without current.
    """
    if gap_s < DISCONNECTED_S or a.below_cutoff == 0 or a.empty_wait_soc > 0.0 or a.empty_std > MAX_EMPTY_STD:
        return False
    a.empty_wait_soc, a.below_cutoff = REARM_SOC, 0
    a.empty_anchors += 1
    return True


@njit(cache=True)
def full_std(f: Record, ekf: Record, current_a: float, below_v: float) -> float:
    """Return the std of the SOC at the end of a charge with ``current_a`` [A], ``below_v`` below the charger's voltage [V].

    It consists of ``FULL_STD``, of the SOC that is missing to 1 according to the voltage without the overpotential, and of the
    SOC by which the particles' interiors lag behind. The missing SOC is not subtracted. The charge that defined SOC 1 of the cell
    file may have ended at another current, or the source may report too low a voltage.
    """
    open_v = ocv(1.0, ekf.ocv_v, ekf.ocv_slope_v) - below_v + overpotential(f, ekf, 1.0, current_a)
    missing_soc = 1.0 - soc_from_ocv(open_v, ekf.ocv_v, ekf.ocv_slope_v)
    lead_soc = LEAD_SOC * f.weak * f.x_a[CHARGE_PAIR] * 3600.0 / ekf.capacity_as
    return math.sqrt(FULL_STD**2 + missing_soc**2 + lead_soc**2)


@njit(cache=True)
def empty_std(f: Record, ekf: Record, current_a: float, cutoff_v: float) -> float:
    """Return the std of the SOC at the cut-off voltage under a load [A].

    It consists of the unknown position of the OCV's knee near empty, which grows in the cold, and of the charge that the
    overpotential leaves in the cell.
    """
    open_v = cutoff_v + overpotential(f, ekf, 0.0, current_a)
    left_soc = soc_from_ocv(open_v, ekf.ocv_v, ekf.ocv_slope_v) - soc_from_ocv(cutoff_v, ekf.ocv_v, ekf.ocv_slope_v)
    return math.sqrt((ekf.bias_soc * f.weak) ** 2 + left_soc**2)


@njit(cache=True)
def overpotential(f: Record, ekf: Record, soc: float, current_a: float) -> float:
    """Return the overpotential of the most likely hypothesis with the resistances at ``soc``, positive on discharge [V]."""
    x, ohm = f.mean[f.best], f.ohm
    resistances(soc, ekf.weak_ohm, ekf.strong_ohm, f.weak, f.strong, ohm)
    pairs_v = 0.0
    for k in range(BRANCHES):
        pairs_v += ohm[1 + k] * (f.x_a[k] + x[X + k])
    return math.exp(x[LN_R0]) * ohm[0] * current_a + math.exp(x[LN_R]) * pairs_v


@njit(cache=True)
def apply_anchor(f: Record, ekf: Record, soc: float, std: float) -> None:
    """Correct the filter by an SOC measured with ``std``, or restart its SOC there if it differs by more than ``MAX_STDS``."""
    variance, difference = std * std, soc - f.soc
    if difference * difference > MAX_STDS**2 * (f.soc_std * f.soc_std + variance):
        restart_at_anchor(f, ekf, soc, variance)
    else:
        for q in range(f.count):
            update_by_anchor(f, q, soc, variance)
        choose_best(f)
    mixture_moments(f)


@njit(cache=True)
def apply_prior(f: Record, soc: float, std: float) -> None:
    """Correct the filter by the SOC that a device reports, with ``std``.

    A hypothesis that differs by more than ``MAX_STDS`` only loses weight, as if it differed by ``MAX_STDS``, because the device
    may be wrong. Later voltages decide.
    """
    variance = std * std
    for q in range(f.count):
        total, difference = f.covariance[q, SOC, SOC] + variance, soc - f.mean[q, SOC]
        if difference * difference > MAX_STDS**2 * total:
            f.ln_weight[q] -= 0.5 * (MAX_STDS**2 + math.log(total))
        else:
            update_by_anchor(f, q, soc, variance)
    choose_best(f)
    mixture_moments(f)


@njit(cache=True)
def choose_best(f: Record) -> None:
    """Choose the most likely hypothesis after a correction of the weights, and merge and remove hypotheses."""
    for q in range(f.count):
        if f.ln_weight[q] > f.ln_weight[f.best]:
            f.best = q
    prune_and_merge(f)


@njit(cache=True)
def update_by_anchor(f: Record, q: int, soc: float, variance: float) -> None:
    """Update hypothesis ``q`` and its weight by an SOC. Capacity, offset and OCV nodes are considered, not corrected."""
    x, cov, ph = f.mean[q], f.covariance[q], f.ph
    for k in range(STATES):
        ph[k] = cov[SOC, k]
    innovation, innovation_variance = soc - x[SOC], cov[SOC, SOC] + variance
    f.ln_weight[q] -= 0.5 * (innovation * innovation / innovation_variance + math.log(innovation_variance))
    apply_correction(x, cov, ph, innovation, innovation_variance, HOLD_CELL | HOLD_OFFSET)


@njit(cache=True)
def restart_at_anchor(f: Record, ekf: Record, soc: float, variance: float) -> None:
    """Restart the most likely hypothesis at an SOC, without the biases and the CURVE error that have absorbed a wrong SOC.

    Capacity, offset, OCV nodes, resistances and polarization do not change.
    """
    if f.best != 0:
        copy_hypothesis(f, f.best, 0)
    for q in range(1, f.count):
        clear_hypothesis(f, q)
    f.count, f.best = 1, 0
    x, cov = f.mean[0], f.covariance[0]
    for j in (SOC, B_SLOW, B_FAST, CURVE):
        scale_state(x, cov, j, 0.0)
    x[SOC], cov[SOC, SOC], cov[CURVE, CURVE] = soc, variance, 1.0
    cov[B_SLOW, B_SLOW] = cov[B_FAST, B_FAST] = 0.5 * bias_variance(f, ekf, 0)
    f.ln_weight[0] = f.minute_u[0] = f.ten_minutes_u[0] = 0.0
    f.fast_inflation[0] = f.slow_inflation[0] = 1.0
