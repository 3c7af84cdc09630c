"""Kernel warm-up of a worker.

A worker compiles its kernels before it connects, so that no response to the server is late.
"""

import numpy as np

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.arrays import SAMPLE
from bms_estimator.model.cell import load_cell
from bms_estimator.service.kernel_warm_up import CELL, load_kernels
from bms_estimator.settings.alarm_limits import MIN_CELLS
from bms_estimator.settings.pack import Settings

PACK = "a pack"
"""Name of the pack whose blocks are processed for the warm-up."""
HOUR_NS = 3600 * 10**9
"""Length of an hour [ns]."""


def load_fleet_kernels() -> None:
    """Load the kernels that process blocks. The first start on a machine compiles them."""
    cell, settings = load_cell(CELL), Settings()
    pack = cell.pack(MIN_CELLS, 1)
    samples, cells_v = np.zeros(3, dtype=SAMPLE), np.full((3, MIN_CELLS), cell.cell.nominal_voltage_v)
    samples["time_s"], samples["voltage_v"] = np.arange(3.0), pack.cell.nominal_voltage_v
    partition = Partition(0, lambda _: (settings, pack))
    # the second block finishes an hour, and is of another store
    for sequence, store in enumerate((HOUR_NS, 3 * HOUR_NS), 1):
        block = Block(
            store_created_ns=store, number=1, oldest=1, arrival_s=store / 1e9, samples=samples, cells_v=cells_v
        )
        partition.process(PACK, encode(block), sequence)
    load_kernels()
