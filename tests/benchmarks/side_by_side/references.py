"""References from captures without a model: R_s from pulses, and two time constants from rests.

A rest is used if it lasts at least ten minutes and the load before it has moved enough charge. Its first twenty minutes are
fitted by v = v_inf - b_1 e^(-t/tau_1) - b_2 e^(-t/tau_2), in which each second has the same weight. A real cell relaxes with
more than two time constants, so that the result depends on the length of the window. Therefore this reference can show that a method is
wrong by a factor, but not by some percent.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares

from bms_estimator.calibration.cleaning.rests import resting_samples, true_runs
from bms_estimator.model.arrays import Floats
from tests.benchmarks.side_by_side.pulses import MEDIAN_PULSES, find_pulses
from tests.benchmarks.side_by_side.trials import Block

MIN_REST_S, WINDOW_S = 600.0, 1200.0
"""Minimum duration of a rest, and duration of its part that is fitted [s]."""
MIN_MOVED = 0.02
"""Minimum charge moved by the load before a rest, as a fraction of the capacity. A pulse does not excite the slow RC pair."""
LOWEST_SOC = 0.1
"""SOC below which neither rests nor pulses are used."""
INITIAL_TAUS = (0.01, 0.3)
"""Time constants at the start of the fit [windows]."""
MIN_TAU_S, MAX_TAU_WINDOWS = 1.0, 3.0
"""Lower limit [s] and upper limit [windows] of the time constants."""
MIN_TAU_RATIO = 2.5
"""Minimum ratio of the two time constants. Time constants that are nearer cannot be distinguished from a single one."""
MIN_AMPLITUDE = 3.0
"""Minimum amplitude of each exponential, in multiples of the RMS residual."""
MIN_RESIDUAL_V = 3e-4
"""Lower limit of the RMS residual in this comparison [V]."""


@dataclass(frozen=True)
class Relaxations:
    """SOC and time constants of the rests that show two time constants, shape (n,) each."""

    soc: Floats
    tau_ts_s: Floats
    tau_tl_s: Floats


@dataclass(frozen=True)
class Pulses:
    """R_s from pulses, as running median over ``MEDIAN_PULSES`` pulses; shape (n,) each."""

    time_s: Floats
    soc: Floats
    ohm: Floats


def relaxations(block: Block, capacity_ah: float) -> Relaxations:
    """Return the time constants of every rest that is long enough, follows enough load, and shows two of them."""
    samples = block.samples
    rests = [(first, end) for first, end in true_runs(resting_samples(samples, capacity_ah)) if first > 0]
    rows, soc_before = [], float(block.soc[0])
    for first, end in rests:
        time_s = samples["time_s"][first:end] - samples["time_s"][first - 1]
        moved = abs(soc_before - float(block.soc[first]))
        if time_s[-1] < MIN_REST_S:
            continue
        soc_before = float(block.soc[end - 1])
        if moved > MIN_MOVED and soc_before > LOWEST_SOC:
            taus_s = fit_two_exponentials(time_s, samples["voltage_v"][first:end])
            rows += [(soc_before, *taus_s)] if taus_s else []
    return Relaxations(*np.array(rows).reshape(-1, 3).T)


def fit_two_exponentials(time_s: Floats, voltage_v: Floats) -> tuple[float, float] | None:
    """Return both time constants of a rest [s], the shorter one first; None if the rest does not show two.

    Args:
        time_s: Time since the end of the load, shape (n,) [s].
        voltage_v: Shape (n,) [V].
    """
    in_window = time_s <= WINDOW_S
    time_s, voltage_v = time_s[in_window].astype(np.float64), voltage_v[in_window].astype(np.float64)
    window_s = float(time_s[-1])
    weight = np.sqrt(np.gradient(time_s))  # each second has the same weight, whatever the sample rate

    def fit_amplitudes(ln_taus: Floats) -> tuple[Floats, Floats]:
        """Return v_inf, b_1 and b_2 [V] for these time constants, and the weighted residual."""
        basis = np.column_stack([np.ones_like(time_s), *(-np.exp(-time_s / tau_s) for tau_s in np.exp(ln_taus))])
        amplitudes_v = np.linalg.lstsq(basis * weight[:, None], voltage_v * weight, rcond=None)[0]
        return amplitudes_v, (basis @ amplitudes_v - voltage_v) * weight

    fit = least_squares(
        lambda ln_taus: fit_amplitudes(ln_taus)[1],
        np.log(np.array(INITIAL_TAUS) * window_s),
        bounds=(np.log(MIN_TAU_S), np.log(MAX_TAU_WINDOWS * window_s)),
        x_scale=1.0,
    )
    amplitudes_v, residual = fit_amplitudes(fit.x)
    (short_s, short_v), (long_s, long_v) = sorted(zip(np.exp(fit.x), amplitudes_v[1:], strict=True))
    rms_v = max(float(np.sqrt(residual @ residual / (weight @ weight))), MIN_RESIDUAL_V)
    smaller_v = min(short_v, long_v) * np.sign(short_v + long_v)
    same_sign = short_v * long_v > 0.0  # otherwise the two exponentials only shape each other
    is_at_bound = long_s > 0.99 * MAX_TAU_WINDOWS * window_s
    if not same_sign or abs(smaller_v) < MIN_AMPLITUDE * rms_v or long_s < MIN_TAU_RATIO * short_s or is_at_bound:
        return None
    return float(short_s), float(long_s)


def pulse_resistance(block: Block, capacity_ah: float) -> Pulses:
    """Return R_s from the pulses of a capture above ``LOWEST_SOC``."""
    rows, ohm = find_pulses(block.samples, capacity_ah)
    above = block.soc[rows] > LOWEST_SOC
    rows, ohm = rows[above], ohm[above]
    median_ohm = median_filter(ohm, MEDIAN_PULSES, mode="nearest") if ohm.size else ohm
    return Pulses(block.samples["time_s"][rows], block.soc[rows], median_ohm)


def with_resistance_step(block: Block, more_ohm: float) -> tuple[Block, float]:
    """Return a capture as if the series resistance had grown by ``more_ohm`` at half time, and that time [s]."""
    time_s = block.samples["time_s"]
    jump_s = 0.5 * float(time_s[0] + time_s[-1])
    samples = block.samples.copy()
    after = time_s >= jump_s
    samples["voltage_v"][after] -= more_ohm * samples["current_a"][after]
    return Block(samples, block.soc), jump_s


def settling_time_s(
    time_s: Floats, ratio: Floats, jump_s: float, within: float = 0.1, hold_s: float = 600.0
) -> float | None:
    """Return the time after the step until ``ratio`` stays within ``within`` of 1 for ``hold_s`` [s].

    Args:
        time_s: Shape (n,) [s].
        ratio: Estimated divided by true value, shape (n,).
        jump_s: Time of the step [s].
        within: Permitted deviation of the ratio from 1.
        hold_s: Time for which the ratio must stay there [s].

    Returns:
        Infinite if the ratio never stays there; None if it also deviated for more than half of ``hold_s`` before the step.
    """
    inside = np.abs(ratio - 1.0) < within
    before = (time_s < jump_s) & (time_s >= jump_s - hold_s)
    if not before.any() or inside[before].mean() < 0.5:
        return None
    outside_s = np.append(time_s[(time_s >= jump_s) & ~inside], time_s[-1])
    entries_s = np.concatenate([[jump_s], outside_s])
    lasting = np.flatnonzero(np.diff(entries_s) >= hold_s)
    return float(entries_s[lasting[0]] - jump_s) if lasting.size else np.inf
