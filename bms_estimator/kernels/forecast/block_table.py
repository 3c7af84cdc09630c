"""Blocks of the observed load, each with its largest voltage drop as a function of SOC.

An RC current is the current filtered with the time constant of an RC pair. The table contains the drop for the RC currents with
which the block began when it was observed. A draw enters the block with other RC currents. Because the RC network is linear, it
only adds the voltage of the difference, which decays exponentially.
"""

import math

import numpy as np

from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GRID, TAUS
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
