"""References from the captures without a model: R_s in pulses, two time constants in rests.

A rest is judged where a load that moved enough charge ended and nothing flowed for ten minutes. Its first twenty minutes
are fitted by v = v_inf - b_1 e^(-t/tau_1) - b_2 e^(-t/tau_2), each second weighing the same. A real cell relaxes with more
than two time constants, and which two a fit finds depends on how long it looks: a reference to a factor, not to per cent.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import least_squares

from bms_estimator.calibration.cleaning.rests import resting_samples, true_runs
from bms_estimator.model.arrays import Floats
from tests.benchmarks.pulses import AROUND, pulses
from tests.benchmarks.side_by_side.trials import Block

MIN_REST_S, WINDOW_S = 600.0, 1200.0
MIN_MOVED = 0.02
"""Part of the capacity that the load before has moved: a pulse of seconds leaves the slow branch alone."""
LOWEST_SOC = 0.1
FIRST = (0.01, 0.3)
"""Start of the fit: time constants in windows."""
RANGE = (1.0, 3.0)
"""Limits of the time constants, in seconds and in windows."""
APART = 2.5
"""Two time constants that are nearer are one."""
MIN_SIZE = 3.0
"""Minimum size of each exponential, in RMS of the residual."""
MIN_RESOLUTION_V = 3e-4
"""No fit leaves less [V]."""


@dataclass(frozen=True)
class Relaxations:
    """Rests of a capture that show two time constants, shape (n,) each."""

    soc: Floats
    tau_ts_s: Floats
    tau_tl_s: Floats


@dataclass(frozen=True)
class Pulses:
    """R_s that pulses show, the median of ``AROUND`` of them; shape (n,) each."""

    time_s: Floats
    soc: Floats
    ohm: Floats


def relaxations(block: Block, capacity_ah: float) -> Relaxations:
    """Fit every rest that is good for it."""
    samples = block.samples
    rests = [(a, b) for a, b in true_runs(resting_samples(samples, capacity_ah)) if a > 0]
    found, soc_before = [], float(block.soc[0])
    for first, end in rests:
        time_s = samples["time_s"][first:end] - samples["time_s"][first - 1]
        moved = abs(soc_before - float(block.soc[first]))
        if time_s[-1] < MIN_REST_S:
            continue
        soc_before = float(block.soc[end - 1])
        if moved > MIN_MOVED and soc_before > LOWEST_SOC:
            taus = two_exponentials(time_s, samples["voltage_v"][first:end])
            found += [(soc_before, *taus)] if taus else []
    return Relaxations(*np.array(found).reshape(-1, 3).T)


def two_exponentials(time_s: Floats, voltage_v: Floats) -> tuple[float, float] | None:
    """Time constants of a rest [s], the shorter first; None where it does not show two.

    Args:
        time_s: Shape (n,), since the load ended [s].
        voltage_v: Shape (n,) [V].
    """
    early = time_s <= WINDOW_S
    time_s, voltage_v = time_s[early].astype(np.float64), voltage_v[early].astype(np.float64)
    window_s = float(time_s[-1])
    weight = np.sqrt(np.gradient(time_s))

    def solved(ln_taus: Floats) -> tuple[Floats, Floats]:
        basis = np.column_stack([np.ones_like(time_s), *(-np.exp(-time_s / tau) for tau in np.exp(ln_taus))])
        sizes = np.linalg.lstsq(basis * weight[:, None], voltage_v * weight, rcond=None)[0]
        return sizes, (basis @ sizes - voltage_v) * weight

    fit = least_squares(
        lambda ln_taus: solved(ln_taus)[1],
        np.log(np.array(FIRST) * window_s),
        bounds=(np.log(RANGE[0]), np.log(RANGE[1] * window_s)),
        x_scale=1.0,
    )
    sizes, left = solved(fit.x)
    (short, short_v), (long, long_v) = sorted(zip(np.exp(fit.x), sizes[1:], strict=True))
    rms_v = max(float(np.sqrt(left @ left / (weight @ weight))), MIN_RESOLUTION_V)
    seen = min(short_v, long_v) * np.sign(short_v + long_v)
    same_sign = short_v * long_v > 0.0
    if not same_sign or abs(seen) < MIN_SIZE * rms_v or long < APART * short or long > 0.99 * RANGE[1] * window_s:
        return None
    return float(short), float(long)


def pulse_resistance(block: Block, capacity_ah: float) -> Pulses:
    """R_s over time, above ``LOWEST_SOC``."""
    rows, ohm = pulses(block.samples, capacity_ah)
    above = block.soc[rows] > LOWEST_SOC
    rows, ohm = rows[above], ohm[above]
    around = median_filter(ohm, AROUND, mode="nearest") if ohm.size else ohm
    return Pulses(block.samples["time_s"][rows], block.soc[rows], around)


def with_jump(block: Block, more_ohm: float) -> tuple[Block, float]:
    """The capture as if its cell's series resistance had grown by ``more_ohm`` half-way, and when that was [s]."""
    time_s = block.samples["time_s"]
    jump_s = 0.5 * float(time_s[0] + time_s[-1])
    samples = block.samples.copy()
    after = time_s >= jump_s
    samples["voltage_v"][after] -= more_ohm * samples["current_a"][after]
    return Block(samples, block.soc), jump_s


def settled_after(
    time_s: Floats, ratio: Floats, jump_s: float, within: float = 0.1, hold_s: float = 600.0
) -> float | None:
    """Return the time after the step until ``ratio`` stays within ``within`` of 1 for ``hold_s`` [s].

    Args:
        time_s: Shape (n,) [s].
        ratio: Shape (n,), of what is said to what is true.
        jump_s: When it jumped [s].
        within: How near.
        hold_s: For how long [s].

    Returns:
        Infinite where it never does; None where it was no nearer before the jump: then it tells nothing.
    """
    inside = np.abs(ratio - 1.0) < within
    before = (time_s < jump_s) & (time_s >= jump_s - hold_s)
    if not before.any() or inside[before].mean() < 0.5:
        return None
    outside_s = np.append(time_s[(time_s >= jump_s) & ~inside], time_s[-1])
    entries_s = np.concatenate([[jump_s], outside_s])
    lasting = np.flatnonzero(np.diff(entries_s) >= hold_s)
    return float(entries_s[lasting[0]] - jump_s) if lasting.size else np.inf
