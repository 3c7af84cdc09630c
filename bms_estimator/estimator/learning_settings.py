"""Settings record of the learning law from typed settings."""

import math

import numpy as np
from numpy.typing import NDArray

from bms_estimator.kernels.cell_model.chen_mora import PARAMETERS, delta
from bms_estimator.kernels.observer.chen_mora_sensitivity import NAMES
from bms_estimator.kernels.observer.learning_model import Model
from bms_estimator.kernels.observer.learning_records import LEARNING_SETTINGS
from bms_estimator.model.cell import CellModel
from bms_estimator.settings.observer import ObserverSettings

MEMORY_S = 3600.0
"""Time constant with which data are discounted under load [s]."""
OFFSET_S = 600.0
"""Time constant with which the injection absorbs an error of the open-circuit voltage [s]."""
SETTLE_S = 1200.0
"""Settling time after an unmeasured gap [s]: at least three time constants of the slow RC pair."""
RATE_HZ = 1.0 / 60.0
"""gamma: rate at which theta approaches the solution of the data, at k = 1 [1/s]."""
LEAK_S = 10.0
"""Weight of the nominal parameters, as a duration of data with errors of ``epsilon_v`` [s]."""
MIN_HALF_RANGE = 1e-3
"""Minimum half distance between the bounds of theta in the weight of the leakage, because it is a divisor."""
REACH = 0.5
"""Trust region for theta. The sensitivities are a linearization; beyond this step the second-order error is no longer
small."""
TAU_TS, TAU_TL = NAMES.index("tau_ts"), NAMES.index("tau_tl")
"""Indices of the time constants in theta."""
SCALED_INDICES = {"r_s": (13, 15), "r_ts": (1, 3), "tau_ts": (7, 9), "r_tl": (4, 6), "tau_tl": (10, 12)}
"""Indices of amplitude and offset, the a_i that scale with each element of theta. A time constant has the bounds of its
capacitance, because its resistance has the value of the cell file."""


def learning_settings(cell: CellModel, observer: ObserverSettings, observer_record: np.void) -> NDArray[np.void]:
    """Return the learning law's settings record.

    Args:
        cell: The pack as one two-terminal object.
        observer: Section ``[observer]``.
        observer_record: Record of dtype ``OBSERVER_SETTINGS``.

    Returns:
        Shape (1,), dtype ``LEARNING_SETTINGS``.
    """
    record = np.zeros(1, dtype=LEARNING_SETTINGS)
    q, a, n = record[0], cell.a, len(NAMES)
    q["enabled"], q["model"], q["count"] = observer.law == "learning", Model.CHEN_MORA, n
    q["file"][1:] = a[1:PARAMETERS]
    for j, name in enumerate(NAMES):
        q["lower"][j], q["upper"][j] = _bounds(cell, SCALED_INDICES[name])
    # tau_ts must stay below the geometric mean of both time constants, and tau_tl above it; 0, the value of the file, is
    # allowed even if the file has them in the reverse order
    ln_to_mean = max(0.5 * math.log(a[6] * a[12] / (a[3] * a[9])), 0.0)
    q["upper"][TAU_TS], q["lower"][TAU_TL] = min(q["upper"][TAU_TS], ln_to_mean), max(q["lower"][TAU_TL], -ln_to_mean)
    q["middle"] = 0.5 * (q["lower"] + q["upper"])
    error_v = float(observer_record["epsilon_v"])
    half_range = 0.5 * (q["upper"] - q["lower"])
    q["leak_v2s"][:n] = LEAK_S * error_v**2 / np.maximum(half_range[:n], MIN_HALF_RANGE) ** 2
    q["memory_s"], q["offset_s"], q["settle_s"] = MEMORY_S, OFFSET_S, SETTLE_S
    q["rate"], q["reach"] = RATE_HZ, REACH
    q["told_v"], q["cells"] = error_v, cell.cell.series_count
    q["soc_floor"] = max(delta(a[8], a[9], a[7]), delta(a[11], a[12], a[10])) + observer.margin_guard
    return record


def _bounds(cell: CellModel, scaled: tuple[int, ...]) -> tuple[float, float]:
    """Return the bounds of an element of theta from those of its ``scaled`` parameters. 0, the file's value, is included."""
    bounds = [(cell.bounds(i), cell.a[i]) for i in scaled]
    lower = max(math.log(b.lower / value) for b, value in bounds)
    upper = min(math.log(b.upper / value) for b, value in bounds)
    return min(lower, 0.0), max(upper, 0.0)
