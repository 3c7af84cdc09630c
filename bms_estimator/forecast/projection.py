"""Distribution of the time to the cut-off: Monte Carlo simulation of the pack under drawn or given loads.

A given load is reduced to fewer parts, so that a profile with a high resolution does not slow down a forecast.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bms_estimator.forecast.available_power import ForecastCurve
from bms_estimator.forecast.load_history import MINUTE_S, LoadSpread
from bms_estimator.forecast.trip import GivenLoad
from bms_estimator.kernels.forecast.draws import DRAW, draw_load_factors, draw_packs
from bms_estimator.kernels.forecast.given_load import LOAD_PART, set_decays, simulate_given_load
from bms_estimator.kernels.forecast.observed_load import (
    LOAD_BLOCK,
    record_curves,
    simulate_observed_load,
    tabulate_blocks,
)
from bms_estimator.model.arrays import Floats, Records


def condense(load: GivenLoad, block_s: float) -> GivenLoad:
    """Return a load whose short parts are merged. Mean and peak of each block remain, because a peak may end the discharge.

    The parts that begin within a block become two parts: the mean of all but the largest load, and then the largest load.

    Args:
        load: Load; either all parts have a current, or all have a power.
        block_s: Length of a block [s].
    """
    ends_s = np.cumsum(load.duration_s)
    block = np.floor((ends_s - load.duration_s) / block_s)
    values = load.power_w if np.isnan(load.current_a).all() else load.current_a
    order = np.lexsort((values, block))  # by block, and within a block by load
    duration_s, values, block = load.duration_s[order], values[order], block[order]
    first = np.flatnonzero(np.diff(block, prepend=-1.0))
    peak = np.append(first[1:], block.size) - 1  # the last part of each block has its largest load
    others_s = np.add.reduceat(duration_s, first) - duration_s[peak]
    others_sum = np.add.reduceat(duration_s * values, first) - duration_s[peak] * values[peak]
    mean = np.divide(others_sum, others_s, out=np.zeros(first.size), where=peak > first)
    mean = np.minimum(mean, values[peak])  # rounding may lift the mean above the peak
    merged_s = _interleave(np.where(peak > first, others_s, 0.0), duration_s[peak])
    merged = _interleave(mean, values[peak])[merged_s > 0.0]
    merged_s, unknown = merged_s[merged_s > 0.0], np.full(merged.size, np.nan)
    if np.isnan(load.current_a).all():
        return GivenLoad(merged_s, current_a=unknown, power_w=merged)
    return GivenLoad(merged_s, current_a=merged, power_w=unknown)


def _interleave(first: Floats, second: Floats) -> Floats:
    """Return two arrays of shape (n,) interleaved, shape (2 n,)."""
    return np.stack([first, second], axis=1).ravel()


DRAWS = 1000
"""Number of draws."""
CURVE_DRAWS = 200
"""Number of draws from which the curves are computed."""
CURVE_POINTS = 60
"""Maximum number of points of a curve."""
DRAWN_LOADS_WEIGHT = 3
"""Weight of randomly drawn loads, if the weight of each analogue is 1. The draws are divided in proportion to the weights."""
MIN_OBSERVED_BLOCK_S = 10
"""Minimum length of a block of the observed load [s]."""
MAX_STEPS = 360
"""Maximum number of blocks of a draw. For a longer horizon the blocks are longer, so that the cost is bounded."""
MIN_BLOCKS = 10
"""Minimum number of blocks in the observed load. It limits the length of a block, so that the bootstrap has enough of them."""
MAX_TIME_TO_EMPTY_S = 1e9
"""Time in which a load must draw the whole charge, to count as a discharge [s]: 30 years."""
HORIZON_RATIO = 1.5
"""Horizon of the draws, in multiples of the time in which the mean load draws the whole charge. Draws that have not
ended by then are extrapolated at the mean load."""
CURVE_END = 1.05
"""Length of the curves in multiples of the 95 % quantile of the time to the cut-off."""
MIN_REMAINING_SOC = 0.02
"""Minimum SOC for the horizon. The true SOC of a draw may be higher than an estimate near 0."""
END_TOLERANCE = 1e-9
"""Fraction by which a trip is shortened, so that rounding does not start a repetition of its load."""
MIN_GIVEN_BLOCK_S = 1.0
"""Minimum length of a block of a given load [s]. Shorter parts are merged to mean and peak of a block."""
MAX_BLOCKS = 2500
"""Maximum number of blocks of a given load within a horizon."""
MAX_DRAW_STEPS = 20_000
"""Maximum number of parts of a given load in a draw. A short load that discharges the pack slowly would repeat more often. After
this number the outcome is extrapolated."""
MAX_TOTAL_STEPS = 500_000
"""Maximum number of steps of all draws under a given load, unless there are only ``MIN_DRAWS``."""
MIN_DRAWS = 100
"""Minimum number of draws under a given load with many parts."""
QUANTILES = 0.05, 0.5, 0.95


@dataclass(frozen=True)
class Projection:
    """Outcomes of the draws.

    Attributes:
        time_s: Time to the cut-off of each draw [s]; infinite if the load never discharges the pack.
        charge_as: Charge until the cut-off of each draw [A s].
        curve: Quantiles of SOC and voltage over time, and the probability that the cut-off is still ahead.
    """

    time_s: Floats
    charge_as: Floats
    curve: ForecastCurve


def project_observed_load(
    pack: Records, mean_a: Floats, max_a: Floats, spread: LoadSpread, seed: int, analogues: Sequence[GivenLoad] = ()
) -> Projection:
    """Simulate the pack under loads drawn from the observed load.

    Args:
        pack: Shape (1,), dtype ``PROJECTED_PACK``.
        mean_a: Mean current of each second [A], with a mean above the offset of the sensor.
        max_a: Largest current of each second [A].
        spread: Spread of the mean future load around the mean of the drawn load.
        seed: Seed of the random numbers, 0 to 2**64 - 1.
        analogues: Loads that followed similar loads of earlier discharges. Some of the draws follow them instead of drawn loads.
    """
    m = pack[0]
    load_a = float(mean_a.mean() - m["offset_a"])
    horizon_s = HORIZON_RATIO * _time_to_empty_s(pack, load_a)
    block_s = min(max(MIN_OBSERVED_BLOCK_S, math.ceil(horizon_s / MAX_STEPS)), max(mean_a.size // MIN_BLOCKS, 1))
    steps = min(math.ceil(horizon_s / block_s), MAX_STEPS)
    blocks = np.zeros(mean_a.size // block_s, LOAD_BLOCK)
    used = blocks.size * block_s
    tabulate_blocks(m, mean_a[-used:], max_a[-used:], block_s, blocks)
    draws = _draws(m, seed)
    draw_load_factors(spread.std, spread.degrees, draws)
    simulate_observed_load(m, blocks, float(block_s), steps, draws)
    parts_of_draws = list(analogue_parts(pack, analogues, horizon_s))
    for followers, parts in parts_of_draws:
        outcomes, no_points = draws[followers], np.empty((followers.size, 0))
        simulate_given_load(m, parts, horizon_s, outcomes, math.inf, no_points, no_points)
        draws[followers] = outcomes
    time_s, charge_as = _extrapolated(draws, load_a)
    curve_steps = min(math.ceil(CURVE_END * time_quantiles(time_s)[-1] / block_s), steps)
    stride = math.ceil(curve_steps / CURVE_POINTS)
    soc, voltage_v = np.empty((2, CURVE_DRAWS, math.ceil(curve_steps / stride)))
    record_curves(m, blocks, float(block_s), curve_steps, draws[:CURVE_DRAWS], stride, soc, voltage_v)
    for followers, parts in parts_of_draws:
        curve_draws = followers[followers < CURVE_DRAWS]
        soc_points, voltage_points_v = np.empty((2, curve_draws.size, soc.shape[1]))
        simulate_given_load(
            m, parts, curve_steps * block_s, draws[curve_draws], stride * block_s, soc_points, voltage_points_v
        )
        soc[curve_draws], voltage_v[curve_draws] = soc_points, voltage_points_v
    elapsed_s: Floats = block_s * (np.arange(soc.shape[1], dtype=np.float64) * stride + 0.5)
    return Projection(time_s, charge_as, _curve(elapsed_s, soc, voltage_v, time_s))


def analogue_parts(
    pack: Records, analogues: Sequence[GivenLoad], horizon_s: float
) -> Iterator[tuple[NDArray[np.int64], Records]]:
    """Yield the indices of the draws that follow each analogue, and its parts, corrected for the offset of the sensor.

    The parts of a load are limited by the horizon, because an analogue of the first days is as long as the whole history.
    """
    block_s = MINUTE_S * math.ceil(horizon_s / (MAX_STEPS * MINUTE_S))
    for number, load in enumerate(analogues):
        reached = np.cumsum(load.duration_s) - load.duration_s < horizon_s + block_s
        current_a = load.current_a[reached] - pack["offset_a"][0]
        true_load = GivenLoad(load.duration_s[reached], current_a, load.power_w[reached])
        yield np.arange(number, DRAWS, len(analogues) + DRAWN_LOADS_WEIGHT), _parts(true_load, horizon_s, block_s)


def project_given_load(pack: Records, load: GivenLoad, seed: int) -> Projection:
    """Simulate the pack under a given load.

    Args:
        pack: Shape (1,), dtype ``PROJECTED_PACK``.
        load: Load to expect.
        seed: Seed of the random numbers, 0 to 2**64 - 1.
    """
    m = pack[0]
    load_a = _mean_current(pack, load)
    if not discharges(pack, load_a):
        load_a = 0.0  # the load is simulated once, because a peak may still reach the cut-off
    horizon_s = HORIZON_RATIO * _time_to_empty_s(pack, load_a) if load_a > 0.0 else float(load.duration_s.sum())
    parts = _parts(_prolonged(load, horizon_s), horizon_s)
    horizon_s = min(horizon_s, MAX_DRAW_STEPS * float(parts["duration_s"].mean()))
    draws = _draws(m, seed)[: _draw_count(parts, horizon_s)]
    no_points = np.empty((draws.size, 0))
    simulate_given_load(m, parts, horizon_s, draws, math.inf, no_points, no_points)
    time_s, charge_as = _extrapolated(draws, load_a)
    end_s = min(CURVE_END * time_quantiles(time_s)[-1], horizon_s)
    soc, voltage_v = np.empty((2, min(CURVE_DRAWS, draws.size), CURVE_POINTS))
    step_s = max(end_s, 1.0) / (CURVE_POINTS - 1)  # above 0 also if the cut-off comes at once
    simulate_given_load(m, parts, end_s, draws[:CURVE_DRAWS], step_s, soc, voltage_v)
    return Projection(
        time_s, charge_as, _curve(step_s * np.arange(CURVE_POINTS, dtype=np.float64), soc, voltage_v, time_s)
    )


def time_quantiles(time_s: Floats) -> tuple[float, float, float]:
    """Return the 5 %, 50 % and 95 % quantiles of times, which may be infinite [s]."""
    low_s, median_s, high_s = np.quantile(time_s, QUANTILES, method="inverted_cdf").tolist()
    return low_s, median_s, high_s


def project_until_load_end(pack: Records, load: GivenLoad, seed: int) -> ForecastCurve:
    """Return the curves until the end of a load. Their last point is that end.

    Args:
        pack: Shape (1,), dtype ``PROJECTED_PACK``.
        load: Load to expect.
        seed: Seed of the random numbers, 0 to 2**64 - 1.
    """
    end_s = float(load.duration_s.sum())
    horizon_s = (1.0 - END_TOLERANCE) * end_s
    parts = _parts(load, end_s)
    draws = _draws(pack[0], seed)[: _draw_count(parts, end_s)]
    step_s, (soc, voltage_v) = horizon_s / (CURVE_POINTS - 1), np.empty((2, draws.size, CURVE_POINTS))
    simulate_given_load(pack[0], parts, horizon_s, draws, step_s, soc, voltage_v)
    time_s = np.where(draws["ended"] == 1, draws["time_s"], math.inf)
    return _curve(step_s * np.arange(CURVE_POINTS, dtype=np.float64), soc, voltage_v, time_s)


def discharges(pack: Records, load_a: float) -> bool:
    """Return True if a load with a mean of ``load_a`` [A] discharges the pack within ``MAX_TIME_TO_EMPTY_S``."""
    return load_a > 0.0 and _time_to_empty_s(pack, load_a) <= MAX_TIME_TO_EMPTY_S


def _time_to_empty_s(pack: Records, load_a: float) -> float:
    """Return the time in which the mean load draws the whole remaining charge, at least 2 % of the capacity [s]."""
    return max(float(pack["soc"][0]), MIN_REMAINING_SOC) * float(pack["capacity_as"][0]) / load_a


def _mean_current(pack: Records, load: GivenLoad) -> float:
    """Return the mean current of a given load [A]. A power counts as a current at the present voltage without load."""
    soc_points = pack["voltage_v"].shape[1] - 1
    present_v = float(pack["voltage_v"][0, round(min(max(float(pack["soc"][0]), 0.0), 1.0) * soc_points)])
    current_a = np.where(np.isnan(load.current_a), load.power_w / present_v, load.current_a)
    return float(np.average(current_a, weights=load.duration_s))


def _prolonged(load: GivenLoad, horizon_s: float) -> GivenLoad:
    """Return a load with longer parts if it would repeat too often within the horizon, otherwise the load unchanged.

    A constant load lasts for the whole horizon. A profile shorter than ``MIN_GIVEN_BLOCK_S`` is stretched to this length.
    """
    length_s, end_s = horizon_s if load.duration_s.size == 1 else MIN_GIVEN_BLOCK_S, float(load.duration_s.sum())
    return replace(load, duration_s=load.duration_s / end_s * length_s) if end_s < length_s else load


def _draw_count(parts: Records, horizon_s: float) -> int:
    """Return the number of draws for a horizon, which limits the cost of a load with many parts."""
    steps = math.ceil(horizon_s / float(parts["duration_s"].mean()))
    return min(max(MAX_TOTAL_STEPS // steps, MIN_DRAWS), DRAWS)


def _parts(load: GivenLoad, horizon_s: float, block_s: float | None = None) -> Records:
    """Return the parts of a load for a horizon: long parts are divided, and those within a block of ``block_s`` [s] are merged."""
    load = condense(load, block_s or max(horizon_s / MAX_BLOCKS, MIN_GIVEN_BLOCK_S))
    max_part_s = max(horizon_s / MAX_STEPS, MIN_GIVEN_BLOCK_S)
    pieces = np.ceil(load.duration_s / max_part_s).astype(int)
    parts = np.zeros(int(pieces.sum()), LOAD_PART)
    parts["duration_s"] = np.repeat(load.duration_s / pieces, pieces)
    parts["current_a"], parts["power_w"] = np.repeat(load.current_a, pieces), np.repeat(load.power_w, pieces)
    set_decays(parts)
    return parts


def _draws(m: np.void, seed: int) -> Records:
    """Return draws of the pack, shape (DRAWS,), dtype ``DRAW``."""
    draws = np.zeros(DRAWS, DRAW)
    draw_packs(m, np.uint64(seed), draws)
    return draws


def _extrapolated(draws: Records, load_a: float) -> tuple[Floats, Floats]:
    """Return time [s] and charge [A s] to the cut-off of each draw.

    Draws without a cut-off before the horizon continue at the mean load down to the median SOC at which the others ended.
    """
    ended, end_soc, time_s = draws["ended"] == 1, draws["soc"].copy(), draws["time_s"].copy()
    if not ended.all():
        last_soc = float(np.median(end_soc[ended])) if ended.any() else 0.0
        end_soc[~ended] = np.minimum(end_soc[~ended], last_soc)
        left_as = (draws["soc"] - end_soc) * draws["capacity_as"]
        time_s[~ended] += (left_as / (draws["load_factor"] * load_a))[~ended] if load_a > 0.0 else math.inf
    return time_s, (draws["begin_soc"] - end_soc) * draws["capacity_as"]


def _curve(elapsed_s: Floats, soc: Floats, voltage_v: Floats, time_s: Floats) -> ForecastCurve:
    """Return the curves of the quantiles over all draws, and of the fraction of draws without cut-off.

    Args:
        elapsed_s: Time of each point [s], shape (points,).
        soc: SOC of each draw, shape (draws, points).
        voltage_v: Terminal voltage of each draw [V], shape (draws, points).
        time_s: Time to the cut-off of each draw [s].
    """
    survival = 1.0 - np.searchsorted(np.sort(time_s), elapsed_s, side="right") / time_s.size
    socs, voltages_v = np.clip(np.quantile(soc, QUANTILES, axis=0), 0.0, 1.0), np.quantile(voltage_v, QUANTILES, axis=0)
    return ForecastCurve(
        elapsed_s,
        soc_p05=socs[0],
        soc_p50=socs[1],
        soc_p95=socs[2],
        voltage_p05_v=voltages_v[0],
        voltage_p50_v=voltages_v[1],
        voltage_p95_v=voltages_v[2],
        survival=survival,
    )
