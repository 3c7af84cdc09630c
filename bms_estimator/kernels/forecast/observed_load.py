"""Simulation of draws under a load like the observed one: stationary bootstrap of its blocks (Politis and Romano 1994).

Each draw starts at a random block and passes the following blocks in order. After ``MEAN_RUN_S`` on average it jumps to another
random block.

A table contains the largest voltage drop of each block as a function of SOC. An RC current is the current filtered with the time
constant of an RC pair. The tabulated drop holds for the RC currents at the beginning of the block when it was observed. A draw
enters the block with other RC currents. Because the RC network is linear, the draw only adds the voltage of the difference,
which decays exponentially.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, TAUS
from bms_estimator.kernels.forecast.draws import loaded_voltage, uniform
from bms_estimator.kernels.forecast.projected_pack import grid_position
from bms_estimator.model.arrays import Floats, Record, Records
from bms_estimator.numba_cache import njit

PEAK_FRACTION = 0.35
"""Response of the RC pair of 1 s to a peak shorter than a second, as a fraction of the peak. The mean step response of this
pair over the first second is 1/e."""

LOAD_BLOCK = np.dtype(
    [
        ("mean_a", "f8"),  # mean current [A]
        ("drop_v", "f8", GRID),  # largest voltage drop at each node of SOC 0..1 [V]
        ("peak_s", "f8"),  # time from the beginning to the largest drop [s]
        ("peak_decay", "f8", BRANCHES),  # decay factor of each RC pair until the largest drop
        ("begin_a", "f8", BRANCHES),  # RC currents at the beginning [A]
        ("end_a", "f8", BRANCHES),  # RC currents at the end [A]
        ("mean_x_a", "f8", BRANCHES),  # mean RC currents [A]
    ],
    align=True,
)
"""Block of the observed load."""

MEAN_RUN_S = 300.0
"""Mean time between two jumps of a draw [s]. The order of the observed load is preserved on this time scale."""
NEGLIGIBLE_DIFFERENCE_C = 1e-3
"""Difference of an RC current below which it counts as zero, as a C-rate."""


@njit(cache=True)
def tabulate_blocks(m: Record, mean_a: Floats, max_a: Floats, block_s: int, blocks: Records) -> None:
    """Tabulate the observed load in blocks of ``block_s`` seconds.

    Args:
        m: Record of PROJECTED_PACK.
        mean_a: Mean current of each second [A], shape (block_s * blocks.size,).
        max_a: Largest current of each second [A].
        block_s: Length of a block [s].
        blocks: Shape (n,), dtype LOAD_BLOCK; written.
    """
    x, decay, drop = np.empty(BRANCHES), np.exp(-1.0 / TAUS), np.empty(GRID)
    # the peak of a block is at its largest drop at the present SOC
    present_node = round(min(max(m.soc, 0.0), 1.0) * (GRID - 1))
    x[:] = mean_a.mean() - m.offset_a  # the RC currents before the first second are unknown
    for n in range(blocks.shape[0]):
        block = blocks[n]
        block.mean_a, block.peak_s, block.mean_x_a[:], block.begin_a[:] = 0.0, 0.0, 0.0, x
        block.drop_v[:] = -math.inf
        for j in range(n * block_s, (n + 1) * block_s):
            current_a, peak_a = mean_a[j] - m.offset_a, max_a[j] - m.offset_a
            block.mean_a += current_a / block_s
            drop[:] = 0.0
            for k in range(BRANCHES):
                x[k] = current_a + (x[k] - current_a) * decay[k]
                block.mean_x_a[k] += x[k] / block_s
                x_a = x[k] + (PEAK_FRACTION * (peak_a - current_a) if k == 0 else 0.0)
                for i in range(GRID):
                    drop[i] += m.ohm[1 + k, i] * x_a
            for i in range(GRID):
                drop[i] += m.ohm[0, i] * peak_a
            if drop[present_node] > block.drop_v[present_node]:
                block.peak_s = j - n * block_s + 1.0
            for i in range(GRID):
                block.drop_v[i] = max(block.drop_v[i], drop[i])
        block.end_a[:] = x
        for k in range(BRANCHES):
            block.peak_decay[k] = math.exp(-block.peak_s / TAUS[k])


@njit(cache=True, nogil=True)  # a request for a forecast runs in a thread, while the event loop reads samples
def simulate_observed_load(m: Record, blocks: Records, block_s: float, steps: int, draws: Records) -> None:
    """Simulate each draw until the cut-off, or for ``steps`` blocks.

    Args:
        m: Record of PROJECTED_PACK.
        blocks: Shape (n,), dtype LOAD_BLOCK.
        block_s: Length of a block [s].
        steps: Maximum number of blocks of a draw.
        draws: Shape (draws,), dtype DRAW, by ``draw_packs``; the outcomes are written.
    """
    decay, no_points = np.exp(-block_s / TAUS), np.empty(0)
    for n in range(draws.shape[0]):
        simulate_draw(m, blocks, block_s, steps, draws[n], decay, 0, no_points, no_points)


@njit(cache=True, nogil=True)  # a request for a forecast runs in a thread, while the event loop reads samples
def record_curves(
    m: Record,
    blocks: Records,
    block_s: float,
    steps: int,
    draws: Records,
    stride: int,
    soc: Floats,
    voltage_v: Floats,
) -> None:
    """Simulate draws as ``simulate_observed_load`` does, and write SOC and mean voltage at every ``stride``-th block.

    After the cut-off, the points of a draw have the SOC at the cut-off and the cut-off voltage. ``soc`` and ``voltage_v`` have
    the shape (draws, points). The outcomes of the draws are overwritten.
    """
    decay = np.exp(-block_s / TAUS)
    for n in range(draws.shape[0]):
        simulate_draw(m, blocks, block_s, steps, draws[n], decay, stride, soc[n], voltage_v[n])


@njit(cache=True)
def simulate_draw(
    m: Record,
    blocks: Records,
    block_s: float,
    steps: int,
    d: Record,
    decay: Floats,
    stride: int,
    soc_points: Floats,
    voltage_points_v: Floats,
) -> None:
    """Simulate one draw until the cut-off, or for ``steps`` blocks. With ``stride`` above 0, write its curve.

    ``decay`` is the decay factor of each RC pair over a block. The other arguments are those of ``record_curves``.
    """
    begin_load(m, blocks, block_s, d)
    soc, d.ended, step = d.begin_soc, 0, 0
    while step < steps:
        block = blocks[d.block]
        drawn_soc = d.load_factor * block.mean_a * block_s / d.capacity_as
        middle_soc = min(soc - 0.5 * drawn_soc, 1.0)
        i, t = grid_position(middle_soc)
        difference_v = difference_drop(m, d, block, i, t)
        drop_v = d.load_factor * (block.drop_v[i] + t * (block.drop_v[i + 1] - block.drop_v[i])) + difference_v
        if loaded_voltage(d, m, middle_soc, drop_v) <= m.cutoff_v:
            d.ended = 1
            break
        if stride > 0 and step % stride == 0:
            mean_drop_v = d.load_factor * mean_drop(m, block, i, t) + difference_v
            soc_points[step // stride] = middle_soc
            voltage_points_v[step // stride] = loaded_voltage(d, m, middle_soc, mean_drop_v)
        soc = min(soc - drawn_soc, 1.0)
        step += 1
        advance_load(blocks, block_s, decay, d)
    d.time_s, d.soc = step * block_s, soc
    if d.ended:
        block = blocks[d.block]
        d.time_s += block.peak_s
        d.soc -= d.load_factor * block.mean_a * block.peak_s / d.capacity_as
    if stride > 0:
        for point in range((step + stride - 1) // stride, soc_points.size):
            soc_points[point], voltage_points_v[point] = d.soc, m.cutoff_v


@njit(cache=True)
def begin_load(m: Record, blocks: Records, block_s: float, d: Record) -> None:
    """Set the first block of a draw, and the differences of its RC currents from the tabulated ones."""
    d.generator, d.first_pair = d.first_generator, 0
    jump(blocks, block_s, d)
    for k in range(BRANCHES):
        d.difference_a[k] = m.x_a[k] - d.load_factor * blocks[d.block].begin_a[k]


@njit(cache=True)
def advance_load(blocks: Records, block_s: float, decay: Floats, d: Record) -> None:
    """Set the next block of a draw, and the differences of its RC currents from those at the beginning of the tabulated block."""
    negligible_a = NEGLIGIBLE_DIFFERENCE_C * d.capacity_as / 3600.0
    for k in range(d.first_pair, BRANCHES):
        d.difference_a[k] *= decay[k]
    while d.first_pair < BRANCHES and abs(d.difference_a[d.first_pair]) < negligible_a:
        d.difference_a[d.first_pair] = 0.0
        d.first_pair += 1
    last = d.block
    d.block = last + 1 if last + 1 < blocks.shape[0] else 0
    d.run -= 1
    if d.run == 0:
        jump(blocks, block_s, d)
    if d.block != last + 1:
        d.first_pair = 0
        for k in range(BRANCHES):
            d.difference_a[k] += d.load_factor * (blocks[last].end_a[k] - blocks[d.block].begin_a[k])


@njit(cache=True)
def jump(blocks: Records, block_s: float, d: Record) -> None:
    """Draw the next block at random, and the number of blocks until the jump after it (geometric distribution)."""
    d.generator, u = uniform(d.generator)
    d.block = int(u * blocks.shape[0])
    d.generator, u = uniform(d.generator)
    probability = min(block_s / MEAN_RUN_S, 1.0)
    d.run = 1 if probability >= 1.0 else 1 + int(math.log(u) / math.log1p(-probability))


@njit(cache=True)
def difference_drop(m: Record, d: Record, block: Record, i: int, t: float) -> float:
    """Return the voltage drop that the differences of the RC currents cause at the peak of a block [V].

    ``i`` and ``t`` are a position in the SOC grid (``grid_position``).
    """
    drop_v = 0.0
    for k in range(d.first_pair, BRANCHES):
        r_ohm = m.ohm[1 + k, i] + t * (m.ohm[1 + k, i + 1] - m.ohm[1 + k, i])
        drop_v += r_ohm * d.difference_a[k] * block.peak_decay[k]
    return drop_v


@njit(cache=True)
def mean_drop(m: Record, block: Record, i: int, t: float) -> float:
    """Return the mean voltage drop of a block with its tabulated RC currents, at a position in the SOC grid [V]."""
    drop_v = (m.ohm[0, i] + t * (m.ohm[0, i + 1] - m.ohm[0, i])) * block.mean_a
    for k in range(BRANCHES):
        drop_v += (m.ohm[1 + k, i] + t * (m.ohm[1 + k, i + 1] - m.ohm[1 + k, i])) * block.mean_x_a[k]
    return drop_v
