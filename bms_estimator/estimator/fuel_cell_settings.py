"""Settings record of the learning law from a fuel cell's file."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.learning_settings import LEAK_S, RATE_HZ, REACH
from bms_estimator.kernels.cell_model.fuel_cell import NAMES
from bms_estimator.kernels.observer.learning_model import Model
from bms_estimator.kernels.observer.learning_records import LEARNING_SETTINGS
from bms_estimator.model.fuel_cell import FuelCellModel

MEMORY_S = 60.0
"""Time constant with which the learning law of a stack discounts data [s]. Water and gas supply change within a minute."""
SETTLE_S = 5.0
"""Settling time of double layer and oxygen supply after an unmeasured gap [s]."""
MAX_FACTORS = {
    "r_ohm": 4.0,
    "tafel_slope_v": 1.5,
    "activation_v": 1.3,
    "c_dl_farad": 4.0,
    "concentration_v": 4.0,
    "limiting_current_a": 2.0,
    "internal_current_a": 4.0,
}
"""Maximum ratio of each parameter to its value in the file. The minimum ratio is the inverse. A ratio of 1.3 of the
activation loss at 1 A corresponds to about 8 of the exchange current."""


def fuel_cell_settings(cell: FuelCellModel, observer_record: np.void) -> NDArray[np.void]:
    """Return the learning law's settings record.

    The output error is not injected as a voltage offset, because a constant voltage error indicates the exchange current.

    Args:
        cell: The stack as one two-terminal object.
        observer_record: Record of dtype ``OBSERVER_SETTINGS``.

    Returns:
        Shape (1,), dtype ``LEARNING_SETTINGS``.
    """
    record = np.zeros(1, dtype=LEARNING_SETTINGS)
    q, n = record[0], len(NAMES)
    q["enabled"], q["model"], q["count"], q["file"] = 1, Model.FUEL_CELL, n, cell.a
    q["upper"][:n] = [math.log(MAX_FACTORS[name]) for name in NAMES]
    q["lower"] = -q["upper"]
    q["told_v"], q["cells"] = observer_record["epsilon_v"], cell.cell.series_count
    q["leak_v2s"][:n] = LEAK_S * float(q["told_v"]) ** 2 / q["upper"][:n] ** 2
    q["memory_s"], q["offset_s"], q["settle_s"] = MEMORY_S, math.inf, SETTLE_S
    q["rate"], q["reach"] = RATE_HZ, REACH
    q["soc_floor"] = -math.inf  # a fuel cell has no SOC
    return record
