"""Benchmark of the estimators of single cells, and of a pack without cell voltages."""

from collections.abc import Iterator

import numpy as np

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import BOARD
from bms_estimator.sources.source import ReceivedSamples
from tests.benchmarks.load import CELL, pulses
from tests.benchmarks.speed.kernel import elapsed_ns
from tests.benchmarks.table import Row

CELLS, CAPACITY_AH, RATE_HZ = 96, 50.0, 10
"""Number of cells of a large pack, its capacity [Ah], and the rate of its samples [1/s]."""
SAMPLES = 20_000
ROUNDS = 30
"""Number of measurements with, and without, the code of the cells. They alternate, and the shortest one of each counts."""
MAX_RATIO = 1.05
"""Maximum ratio of the times with and without the code of the cells, for a pack without cell voltages. Repeated measurements
differ by a few percent."""


def rows() -> Iterator[Row]:
    """Measure the cost of each cell, and the time of a block of one sample without cell voltages."""
    cell_ns = ns_for_each_cell_and_sample()
    share = cell_ns * CELLS * RATE_HZ / 1e9
    yield Row(f"{CELLS} cells: each cell and sample", "at most 1 us", f"{cell_ns:.0f} ns", cell_ns <= 1000.0)
    yield Row(f"  share of a core at {RATE_HZ} Hz", "below 5 %", f"{share:.3%}", share < 0.05)
    with_ns, without_ns = block_of_one_sample_ns()
    yield Row("block of one sample, without the code of single cells", "-", f"{without_ns:.0f} ns", None)
    ratio = with_ns / without_ns
    yield Row(
        "  with this code and no cell voltages, ratio", f"at most {MAX_RATIO}", f"{ratio:.3f}", ratio <= MAX_RATIO
    )


def ns_for_each_cell_and_sample() -> float:
    """Return the time of the estimators for each cell and sample, with one block and one evaluation each second [ns]."""
    estimator = Estimator(load_cell("nmc", CAPACITY_AH).pack(CELLS, 1), sampling=BOARD)
    samples = np.zeros(SAMPLES, SAMPLE)
    samples["time_s"], samples["current_a"], samples["temperature_c"] = np.arange(SAMPLES) / RATE_HZ, 10.0, 25.0
    cells_v = 3.7 + 0.01 * np.random.default_rng(1).standard_normal((SAMPLES, CELLS))
    samples["voltage_v"] = cells_v.sum(axis=1)
    trace, cells = estimator.run(samples), CellEstimator(estimator)

    def run() -> None:
        for begin in range(0, SAMPLES, RATE_HZ):
            part = slice(begin, begin + RATE_HZ)
            cells.run(samples[part], cells_v[part], trace[part])
            _ = cells.deviations  # as for the alarms

    run()  # compiles the kernel
    cells = CellEstimator(estimator)
    return elapsed_ns(run) / (SAMPLES * CELLS)


def block_of_one_sample_ns() -> tuple[float, float]:
    """Return the time of a block of one sample with and without the code of single cells, measured alternately [ns]."""
    samples = pulses(SAMPLES, rate_hz=RATE_HZ)
    received = [ReceivedSamples(samples[i : i + 1], NO_CELLS) for i in range(SAMPLES)]
    estimator = Estimator(load_cell(CELL))
    cells = CellEstimator(estimator)

    def run_with_cells() -> None:
        for each in received:
            trace = estimator.run(each.samples)
            if each.cells_v.size:
                cells.run(each.samples, each.cells_v, trace)

    def run_without_cells() -> None:
        for each in received:
            estimator.run(each.samples)

    run_without_cells()  # until one hypothesis of the filter remains
    best = np.full(2, np.inf)
    for _ in range(ROUNDS):
        for i, run in enumerate((run_with_cells, run_without_cells)):
            estimator.state["started"] = (
                0  # the next sample counts as the first, because its time is before the last one's
            )
            best[i] = min(best[i], elapsed_ns(run))
    with_ns, without_ns = (best / SAMPLES).tolist()
    return with_ns, without_ns
