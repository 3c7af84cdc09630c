"""Summary of an hour's cell voltages: spread, weakest cell, and the deviation of each cell at rest."""

from typing import Any

import numpy as np

from bms_estimator.edge.block import Block

MAX_CELLS = 128
"""Maximum number of cells in series. The rows of a pack with more cells have no values of cells."""
MAX_CELL_V = 10.0
"""Maximum plausible voltage of a cell [V]."""

CELL_SUMS = np.dtype(
    [
        # number of cells; 0 before the first sample with the voltages of all cells
        ("cells", "i8"),
        # number of samples with the voltages of all cells
        ("samples", "i8"),
        # sum of the differences between the highest and the lowest cell [V]
        ("spread_v", "f8"),
        # sum of each cell's deviations from the mean of the cells [V]
        ("deviation_v", "f8", MAX_CELLS),
        # number of these samples at rest
        ("rest_samples", "i8"),
        # sum of each cell's deviations at rest [V]
        ("rest_deviation_v", "f8", MAX_CELLS),
    ],
    align=True,
)
"""Sums of an hour; all zero at its beginning."""


def add(sums: np.void, block: Block, rest_a: float) -> None:
    """Add a block's cell voltages to the sums of the hour. Samples without the voltages of all cells have no effect.

    Args:
        sums: Record of dtype ``CELL_SUMS``; updated.
        block: Block of samples.
        rest_a: Maximum current of a resting pack [A].
    """
    cells = block.cells_v.shape[1]
    if not 2 <= cells <= MAX_CELLS:
        return
    is_complete = ((block.cells_v > 0.0) & (block.cells_v < MAX_CELL_V)).all(axis=1)
    cells_v = block.cells_v[is_complete]
    if not cells_v.size:
        return
    if sums["cells"] != cells:
        for name in CELL_SUMS.names or ():
            sums[name] = 0
        sums["cells"] = cells
    deviation_v = cells_v - cells_v.mean(axis=1, keepdims=True)
    is_rest = np.abs(block.samples["current_a"][is_complete]) <= rest_a
    sums["samples"] += cells_v.shape[0]
    sums["spread_v"] += float(np.ptp(cells_v, axis=1).sum())
    sums["deviation_v"][:cells] += deviation_v.sum(axis=0)
    sums["rest_samples"] += np.count_nonzero(is_rest)
    sums["rest_deviation_v"][:cells] += deviation_v[is_rest].sum(axis=0)


def values(sums: np.void) -> dict[str, Any]:
    """Return the values of cells of an hourly row; empty without cell voltages."""
    cells, samples, rest_samples = int(sums["cells"]), int(sums["samples"]), int(sums["rest_samples"])
    if not samples:
        return {}
    deviation_v = sums["deviation_v"][:cells] / samples
    weakest = int(np.argmin(deviation_v))
    return {
        "cell_spread_v": float(sums["spread_v"]) / samples,
        "weakest_cell": weakest + 1,
        "weakest_cell_v": float(deviation_v[weakest]),
        "cells_rest_v": (sums["rest_deviation_v"][:cells] / rest_samples).tolist() if rest_samples else None,
    }
