"""Filter bank: several filters that start at different SOCs and are merged when they agree.

At switch-on, SOC and polarization are unknown, and far from the true SOC the OCV has another slope. Therefore filters
start at ``HYPOTHESES`` SOCs around the initial one. Each is weighted by its likelihood to a power below 1 (tempering),
because successive errors of the model are not independent. Filters that agree are merged, and unlikely ones are removed.
The output is the mean and standard deviation of the mixture.

``s`` is a record of EKF_STATE, ``p`` of EKF_SETTINGS. Above 1 Hz, each update uses the mean of about a second's samples.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import (
    BRANCHES,
    REFERENCE_C,
    on_grid,
)
from bms_estimator.kernels.kalman_filter.ekf import (
    INDEPENDENT_R_STD,
    MAX_SOC,
    MIN_SOC,
    adapt_bias_inflation,
    predict,
    update,
)
from bms_estimator.kernels.kalman_filter.equivalent_circuit import VARYING
from bms_estimator.kernels.kalman_filter.mixture import (
    clear_hypothesis,
    copy_hypothesis,
    mixture_moments,
    prune_and_merge,
    scale_state,
)
from bms_estimator.kernels.kalman_filter.noise import (
    bias_variance,
    extrapolation_factor,
    initial_branch_currents,
    measurement_variance,
    offset_variance,
    resistance_std,
    skew_variance,
)
from bms_estimator.kernels.kalman_filter.ocv_correction import reset_ocv_correction
from bms_estimator.kernels.kalman_filter.records import (
    B_FAST,
    B_SLOW,
    CURVE,
    HYPOTHESES,
    HYST,
    LN_Q,
    LN_R,
    LN_R0,
    OFFSET,
    SOC,
    X,
)
from bms_estimator.kernels.kalman_filter.window import (
    LONG_TERM_S,
    initialize_load_statistics,
    prepare_transition,
    reset_window,
    update_arrhenius_factors,
    update_load_statistics,
    update_offset_at_rest,
)
from bms_estimator.model.arrays import Record
from bms_estimator.numba_cache import njit

MAX_STD_OF_ONE_HYPOTHESIS = 0.06
"""Maximum std of an initial SOC for which one filter suffices."""
MAX_KEPT_STD = 1.0 / (HYPOTHESES - 2)
"""Maximum std of the SOC after a gap with the usual load at which one hypothesis represents this load. It equals the spacing of
the evenly spaced hypotheses, which represent a wider distribution well enough."""
SPREAD_STDS = 2.25
"""Distance of the outermost hypotheses from the initial SOC, in std of that SOC."""
OVERLAP = 0.62
"""Std of a hypothesis, as a fraction of the distance between neighbors."""
BEYOND_STD = 0.03
"""Std with which the prior weight of an SOC decreases beyond ``MIN_SOC`` and ``MAX_SOC`` [SOC]. A hypothesis there is moved to
the limit."""
HYST_STD = 0.7
"""Initial std of the hysteresis state h."""
EARLIER_LOAD_S = 1800.0
"""Time constant with which effects of the unknown load before switch-on decay [s]."""
REINITIALIZE_STDS = 4.0
"""Bias above which the SOC is re-initialized, in standard deviations. A wrong SOC is more likely than such a model error."""
INCONSISTENT_STDS = 2.0
"""Bias above which a hypothesis loses weight, in standard deviations. The biases of a wrong hypothesis absorb its errors, so
that its innovations alone are small."""
REINITIALIZED_STD = 0.2
"""Std of the SOC after a re-initialization, equal to the default at switch-on."""
PROBIT = 1.702
"""Factor with which the logistic function of a deviation in std approximates its normal probability within 0.01."""
REPEATED_SHARE = 3.0
"""Weight of ln S in repeated updates, per relative growth of the model's errors outside the temperature range of the cell file.
The weight is 1 from 10 K outside. There the resistances are so uncertain that a hypothesis near empty fits every voltage."""
MIN_PROBABILITY = 1e-12
"""Minimum prior probability of a hypothesis, so that its logarithm is finite."""
EXCHANGE_STDS = 3.0
"""Minimum error of the SOC after a gap that shows an exchange of the pack, in standard deviations."""
MAX_EVENT_C = 2.0
"""Maximum mean current of a charge or a discharge in a gap, as a C-rate. A larger change of the SOC is an exchange."""
USER_SOC_STD = 0.03
"""Std of a correct SOC set by the user."""
WRONG_USER_SOC_STD = 0.12
"""Std of a wrong SOC set by the user."""
SHAPE_STD, SHAPE_CORRELATION_SOC = 0.15, 0.4
"""Std and correlation length [SOC] of the relative error of the file's resistances over SOC."""
LN_ODDS_CORRECT = 3.0
"""Additional log-weight of the hypothesis that the user's SOC is correct. All other hypotheses together have a probability
of about 0.1."""


@njit(cache=True)
def initialize_filter(s: Record, p: Record, soc: float, current_a: float, temperature_c: float) -> None:
    """Initialize all states at the first sample, with hypotheses around ``soc`` with a std of ``p.soc_std``."""
    s.started, s.best = 1, 0
    s.current_a = current_a
    s.smallest_a = 0.0
    s.sensed = 1 if math.isfinite(temperature_c) else 0
    s.temperature_c = temperature_c if s.sensed else REFERENCE_C
    update_arrhenius_factors(s)
    initialize_load_statistics(s, p, current_a)
    s.x_a[:] = 0.0
    x, cov = s.mean[0], s.covariance[0]
    x[:] = cov[:, :] = 0.0
    cov[LN_R0, LN_R0] = cov[LN_R, LN_R] = resistance_std(s, p) ** 2
    cov[LN_R0, LN_R] = cov[LN_R, LN_R0] = max(resistance_std(s, p) ** 2 - INDEPENDENT_R_STD**2, 0.0)
    s.learned_soc = s.gap_s = 0.0
    s.exchanged = 0
    s.step.phase, s.step.ln_ratio, s.step.variance = VARYING, 0.0, resistance_std(s, p) ** 2
    cov[OFFSET, OFFSET] = offset_variance(p)
    cov[LN_Q, LN_Q] = p.capacity_std**2
    reset_ocv_correction(p, x, cov)
    spawn_hypotheses(s, p, soc, p.soc_std)
    reset_window(s)


@njit(cache=True)
def spawn_hypotheses(s: Record, p: Record, soc: float, soc_std: float) -> None:
    """Initialize hypotheses around ``soc`` with the most likely hypothesis's estimates of sensor and cell.

    SOC, polarization, hysteresis and errors of the model are unknown.
    """
    if s.best != 0:
        copy_hypothesis(s, s.best, 0)
    forget_state_of_charge(s, p, 0)
    s.x_a[:] = 0.0
    s.count = HYPOTHESES if soc_std > MAX_STD_OF_ONE_HYPOTHESIS else 1
    spacing = 2.0 * SPREAD_STDS * soc_std / (HYPOTHESES - 1)
    for q in range(s.count - 1, -1, -1):
        if q > 0:
            copy_hypothesis(s, 0, q)
        distance = (q - (s.count - 1) // 2) * spacing
        std = OVERLAP * spacing if s.count > 1 else soc_std
        set_initial_soc(s, p, q, min(max(soc + distance, MIN_SOC), MAX_SOC), std)
        s.ln_weight[q] = -0.5 * (distance / soc_std) ** 2 - 0.5 * ((soc + distance - s.mean[q, SOC]) / BEYOND_STD) ** 2
    for q in range(s.count, HYPOTHESES):
        clear_hypothesis(s, q)
    s.best = (s.count - 1) // 2
    begin_search(s)


@njit(cache=True)
def forget_state_of_charge(s: Record, p: Record, q: int) -> None:
    """Set all states of hypothesis ``q`` except those of sensor and cell to their prior, with an SOC of 0 without variance.

    The states X of the RC pairs have the prior of a load that ended with the present current. They then represent the whole
    filtered currents, so that the caller sets ``s.x_a``, the part due to measured currents, to 0.
    """
    mean, covariance = s.mean[q], s.covariance[q]
    for j in (SOC, B_SLOW, B_FAST, HYST, CURVE):
        scale_state(mean, covariance, j, 0.0)
    for k in range(BRANCHES):
        scale_state(mean, covariance, X + k, 0.0)
    initial_branch_currents(p, s.current_a, mean, covariance)
    covariance[HYST, HYST], covariance[CURVE, CURVE] = HYST_STD**2, 1.0
    s.minute_u[q] = s.ten_minutes_u[q] = 0.0
    s.fast_inflation[q] = s.slow_inflation[q] = 1.0


@njit(cache=True)
def set_initial_soc(s: Record, p: Record, q: int, soc: float, std: float) -> None:
    """Set mean and std of a hypothesis's SOC, and the variance of its biases at that SOC."""
    s.mean[q, SOC] = soc
    s.covariance[q, SOC, SOC] = std * std
    half_v2 = 0.5 * bias_variance(s, p, q)
    s.covariance[q, B_SLOW, B_SLOW] = s.covariance[q, B_FAST, B_FAST] = half_v2


@njit(cache=True)
def forget_scales(s: Record, p: Record, q: int, moved_soc: float) -> None:
    """Reduce the learned scales of the resistances to their part that does not depend on the SOC, for an SOC ``moved_soc`` away.

    The file's resistances have an error over SOC: a scale that was learned near empty is not that at full.
    """
    variance = resistance_std(s, p) ** 2
    factor = 1.0 + math.expm1(-abs(moved_soc) / SHAPE_CORRELATION_SOC) * SHAPE_STD**2 / max(variance, SHAPE_STD**2)
    for j in (LN_R0, LN_R):
        scale_state(s.mean[q], s.covariance[q], j, factor)
        s.covariance[q, j, j] += (1.0 - factor**2) * variance


@njit(cache=True)
def begin_search(s: Record) -> None:
    """Begin the time in which the hypotheses are unreliable, and compute the moments of the mixture."""
    s.seeded_s = s.rest_s = s.rest_as = 0.0
    mixture_moments(s)


@njit(cache=True)
def spawn_after_gap(s: Record, p: Record, gap_s: float, rested: bool) -> None:
    """Initialize hypotheses after a gap: one for the usual load or a rest in the gap, and others for any SOC.

    In the gap the pack may have been charged, discharged or exchanged, with a prior probability that grows with ``gap_s``
    [s]. Hypotheses with the same estimates of sensor and cell therefore cover SOC 0 to 1 evenly. One hypothesis remains
    beside them: the usual load if its std is at most ``MAX_KEPT_STD``, otherwise a rest. If the voltage cannot distinguish
    them, the remaining one stays likely. The weights of the others contain the remaining probability of the usual load.

    Args:
        s: Record of EKF_STATE; hypothesis 0 was propagated with the usual load, and hypothesis 1 with a rest.
        p: Record of EKF_SETTINGS.
        gap_s: Duration of the gap [s]; infinite if unknown, with hypothesis 0 only.
        rested: True if the pack rested before the gap.
    """
    soc, std = s.mean[0, SOC], math.sqrt(s.covariance[0, SOC, SOC])
    event = p.event_probability * (1.0 - math.exp(-gap_s / p.event_s))
    kept, kept_probability = 0, 1.0 - event
    if std > MAX_KEPT_STD:
        kept = 0 if gap_s == math.inf else 1
        kept_probability *= rest_probability(soc, std, gap_s, rested)
    even_count = HYPOTHESES - 1
    spacing = 1.0 / (even_count - 1)
    # index of the remaining hypothesis in the order of SOC
    row = min(max(math.ceil(s.mean[kept, SOC] / spacing), 0), even_count)
    if row != kept:
        copy_hypothesis(s, kept, row)
    s.mean[row, X : X + BRANCHES] += s.x_a  # s.x_a becomes 0 below
    # hypothesis ``first`` retains only the estimates of sensor and cell, and is copied to the other evenly spaced ones
    first = 1 if row == 0 else 0
    copy_hypothesis(s, row, first)
    forget_state_of_charge(s, p, first)
    s.x_a[:] = 0.0
    for n in range(even_count - 1, -1, -1):
        q = n if n < row else n + 1
        if q != first:
            copy_hypothesis(s, first, q)
        set_initial_soc(s, p, q, n * spacing, OVERLAP * spacing)
        forget_scales(s, p, q, n * spacing - s.mean[row, SOC])
        weight = event / even_count + (1.0 - event - kept_probability) * spacing * normal_density(n * spacing, soc, std)
        s.ln_weight[q] = math.log(max(weight, MIN_PROBABILITY))
    s.ln_weight[row] = math.log(max(kept_probability, MIN_PROBABILITY))
    s.count, s.best = HYPOTHESES, np.argmax(s.ln_weight)
    begin_search(s)


@njit(cache=True)
def rest_probability(soc: float, std: float, gap_s: float, rested: bool) -> float:
    """Return the probability of a rest in a gap without a charge or an exchange.

    A rest continues with the time constant ``LONG_TERM_S``. A load cannot continue in an empty pack, nor a charge in a full one.
    The usual load leads to an SOC with mean ``soc`` and ``std``. A rest gets the probability of its part beyond 0 and 1.
    """
    if gap_s == math.inf:
        return 0.0
    beyond = 1.0 / (1.0 + math.exp(PROBIT * soc / std)) + 1.0 / (1.0 + math.exp(PROBIT * (1.0 - soc) / std))
    return max(beyond, math.exp(-gap_s / LONG_TERM_S) if rested else 0.0)


@njit(cache=True)
def normal_density(x: float, mean: float, std: float) -> float:
    """Return the density of a normal distribution."""
    return math.exp(-0.5 * ((x - mean) / std) ** 2) / (std * math.sqrt(2.0 * math.pi))


@njit(cache=True)
def end_learning(s: Record, p: Record) -> None:
    """Hold LN_Q from now on, and set the OCV nodes to their prior.

    The nodes learned in one pass have common errors with the SOC of that pass.
    """
    s.learned_soc = p.learning_soc
    for q in range(s.count):
        reset_ocv_correction(p, s.mean[q], s.covariance[q])


@njit(cache=True)
def begin_gap(s: Record, p: Record, gap_s: float) -> None:
    """Store the SOC before a gap of ``gap_s`` [s], and end the learning. A gap of unknown duration (infinite) is stored as 0."""
    s.gap_s = gap_s if gap_s < math.inf else 0.0
    s.soc_before, s.std_before = s.mean[0, SOC], math.sqrt(s.covariance[0, SOC, SOC])
    s.exchanged = 0
    if s.learned_soc < p.learning_soc < math.inf:
        end_learning(s, p)


@njit(cache=True)
def set_soc(s: Record, p: Record, soc: float) -> None:
    """Re-initialize at an SOC set by the user, with hypotheses for a wrong value that later voltages may select."""
    spawn_hypotheses(s, p, soc, WRONG_USER_SOC_STD)
    s.covariance[s.best, SOC, SOC] = USER_SOC_STD**2
    s.ln_weight[s.best] += LN_ODDS_CORRECT
    s.gap_s, s.exchanged = 0.0, 0
    mixture_moments(s)


@njit(cache=True)
def update_hypotheses(s: Record, p: Record) -> None:
    """Update every hypothesis by the samples of the window, then prune and merge."""
    w = s.window
    dt_s = w.time_s
    if dt_s > 0.0:
        if not w.gap:
            update_load_statistics(s, w.charge_as / dt_s, dt_s)
        prepare_transition(s, p)
    update_arrhenius_factors(s)
    s.seeded_s += dt_s
    if s.learned_soc < p.learning_soc:
        s.learned_soc += w.throughput_as / p.capacity_as
        if s.learned_soc >= p.learning_soc:
            end_learning(s, p)
    s.soc_before -= w.charge_as / p.capacity_as  # for its comparison with the present SOC in detect_exchange
    variance_v2 = measurement_variance(s, p, dt_s, w.samples) + skew_variance(s, p)
    best = 0
    for q in range(s.count):
        if dt_s > 0.0:
            predict(s, p, q)
        innovation_v, total_v2, linear_v2 = update(s, p, q, variance_v2)
        u = innovation_v / math.sqrt(total_v2)
        update_weight(s, p, q, innovation_v, linear_v2, variance_v2)
        if dt_s > 0.0 and not w.gap:  # a single innovation after a long gap does not show a persistent error
            adapt_bias_inflation(s, q, dt_s, u)
        if q == 0 or s.ln_weight[q] > s.ln_weight[best]:
            best = q
            s.innovation_v, s.innovation_variance = innovation_v, total_v2
    s.voltage_v = w.sum_v / w.samples - s.innovation_v
    s.best = best
    update_offset_at_rest(s, p)
    prune_and_merge(s)
    mixture_moments(s)
    reinitialize_if_biased(s, p)
    detect_exchange(s)
    reset_window(s)


@njit(cache=True)
def update_weight(s: Record, p: Record, q: int, innovation_v: float, linear_v2: float, variance_v2: float) -> None:
    """Update the log-weight of hypothesis ``q``.

    S excludes the linearization error. That error is constant at rest and would, repeated each second, reject an SOC at a knee of
    the OCV.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        q: Index of the hypothesis.
        innovation_v: Innovation [V].
        linear_v2: S without the linearization error [V^2].
        variance_v2: R [V^2].
    """
    scale = innovation_scale(s, p)
    if s.window.time_s > 0.0 and not s.window.gap:
        linear_v2 = repeated_variance(s, p, innovation_v * innovation_v / scale, linear_v2, variance_v2)
    s.ln_weight[q] -= p.half_likelihood_exponent * (
        innovation_v * innovation_v / (scale * linear_v2) + math.log(linear_v2)
    )
    if s.count > 1:
        s.ln_weight[q] -= p.inconsistency_penalty * max(normalized_bias_squared(s, p, q) - INCONSISTENT_STDS**2, 0.0)


@njit(cache=True)
def repeated_variance(s: Record, p: Record, likeliest_v2: float, linear_v2: float, variance_v2: float) -> float:
    """Return the innovation variance for the weight of a hypothesis after the first update, between R and S [V^2].

    S contains errors that persist from update to update, such as that of the curve at a knee. Repeated each second, the term ln S
    would reject a true SOC at the end of a plateau although it predicts each voltage. Therefore the maximum-likelihood variance
    of the innovation replaces S. Outside the temperature range of the cell file, where innovations are not smaller,
    ``REPEATED_SHARE`` retains a part of S.

    Args:
        s: Record of EKF_STATE.
        p: Record of EKF_SETTINGS.
        likeliest_v2: Maximum-likelihood variance of the innovation [V^2].
        linear_v2: S without the linearization error [V^2].
        variance_v2: R [V^2].
    """
    likeliest_v2 = min(linear_v2, max(variance_v2, likeliest_v2))
    share = min(REPEATED_SHARE * (extrapolation_factor(p, s.temperature_c) - 1.0), 1.0)
    return likeliest_v2 * (linear_v2 / likeliest_v2) ** share


@njit(cache=True)
def innovation_scale(s: Record, p: Record) -> float:
    """Return the expected ratio of the innovation variance to S.

    R and the biases cover the loads and cells that the cell file describes worst. Innovations usually become smaller when the
    effects of the load before switch-on have decayed. The term ln S would then decide between the hypotheses and favor the
    smallest S. Outside the temperature range of the cell file the ratio increases and reaches 1 at a distance of ``OUTSIDE_K``.
    """
    return min(
        max(
            math.exp(-s.seeded_s / EARLIER_LOAD_S),
            p.min_innovation_scale * extrapolation_factor(p, s.temperature_c) ** 2,
        ),
        1.0,
    )


@njit(cache=True)
def reinitialize_if_biased(s: Record, p: Record) -> None:
    """Re-initialize the SOC if the bias of a single remaining hypothesis is larger than plausible model errors."""
    if s.count == 1 and normalized_bias_squared(s, p, 0) > REINITIALIZE_STDS**2:
        spawn_hypotheses(s, p, s.mean[0, SOC], REINITIALIZED_STD)
        s.reopened += 1


@njit(cache=True)
def detect_exchange(s: Record) -> None:
    """Detect that the pack was exchanged in the last gap, because no possible current in the gap explains the SOC after it."""
    error = EXCHANGE_STDS * math.sqrt(s.soc_std**2 + s.std_before**2)
    if s.gap_s > 0.0 and abs(s.soc - s.soc_before) > error + MAX_EVENT_C * s.gap_s / 3600.0:
        s.exchanged = 1


@njit(cache=True)
def normalized_bias_squared(s: Record, p: Record, q: int) -> float:
    """Return the squared bias of a hypothesis over its prior variance.

    The variance includes errors of OCV and hysteresis, because the biases absorb them, too. On a plateau they dominate.
    """
    bias_v, soc = s.mean[q, B_SLOW] + s.mean[q, B_FAST], s.mean[q, SOC]
    hysteresis_v = s.hysteresis * on_grid(soc, p.hysteresis_v)
    prior_v2 = bias_variance(s, p, q) + on_grid(soc, p.curve_error_v) ** 2 + hysteresis_v**2
    return bias_v * bias_v / prior_v2


@njit(cache=True)
def weakest_cell_soc_std(s: Record, p: Record) -> float:
    """Return the std of the SOC of the weakest cell in series, whose deviation from the mean cannot be observed."""
    spread = p.cell_spread * (1.0 - s.soc) if p.series > 1.0 else 0.0
    return math.sqrt(max(s.soc_std, p.min_soc_std) ** 2 + spread**2)
