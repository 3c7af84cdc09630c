"""Test of Theorem 4.1.2 of the thesis: the time constants R_ts C_ts and R_tl C_tl converge to the true values.

The theorem claims this at a small current, whatever the bounds between which the coefficients a1..a12 of these elements
are adapted. Here the observer runs at several currents and with several bounds on a simulated cell. By Lemma 4.1.3 each
a_i converges to its limit, a weighted mean of its bounds.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from bms_estimator.calibration.thesis.adaptive_run import adaptive_run
from bms_estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import Bounds, CellModel
from bms_estimator.reports.thesis.simulation import (
    IDEAL_RESOLUTION_V,
    discharge,
    mean_error_percent,
    observer_settings,
    table_5_cell,
    with_bounds,
)

C_RATES = (1.0, 0.1, 0.01)
"""C-rates of the runs [1/h]. The discharge at the smallest C-rate takes a hundred hours."""
SAMPLES = 100_000
"""Number of samples of each run, from full to empty."""
WEIGHT = 50.0
"""Weight of both bounds [1/s], the most frequent one of Table 5. With equal weights the limit is the middle of the
bounds."""
SETTLED_FROM_S = 60.0
"""Time after which tracking is evaluated [s]."""


@dataclass(frozen=True)
class RunResult:
    """Result of one run.

    Attributes:
        bounds: Description of the bounds.
        c_rate: Current divided by capacity [1/h].
        tracking_v: Maximum |e| from ``SETTLED_FROM_S`` to t_unst [V].
        error_percent: Mean error over SOC of the estimated R_ts C_ts and R_tl C_tl [%].
        limit_percent: Error of the products if a1..a12 are at their Lemma 4.1.3 limits [%].
    """

    bounds: str
    c_rate: float
    tracking_v: float
    error_percent: tuple[float, float]
    limit_percent: tuple[float, float]


PRODUCTS = ("R_ts C_ts", "R_tl C_tl")


def bounds_sets(cell: CellModel) -> dict[str, dict[int, Bounds]]:
    """Return three sets of bounds by name.

    They are the bounds of Table 5, bounds whose limits are the true values, and bounds whose limits are twice the true
    resistances.
    """

    def around(low: float, high: float) -> dict[int, Bounds]:
        bounds = {}
        for i in range(1, 13):
            # only amplitudes and offsets of the resistances have these bounds; exponents and capacitances have the true limit
            is_resistance = i in (1, 3, 4, 6)
            lower, upper = (low, high) if is_resistance else (0.5, 1.5)
            value = float(cell.a[i])
            bounds[i] = Bounds(lower=lower * value, upper=upper * value, weight_upper=WEIGHT, weight_lower=WEIGHT)
        return bounds

    return {
        "Table 5": {i: cell.bounds(i) for i in range(1, 13)},
        "limit at the truth": around(0.5, 1.5),
        "limit at twice the resistances": around(1.0, 3.0),
    }


@cache
def measure() -> tuple[RunResult, ...]:
    """Run each set of bounds at each current on the cell of Table 5."""
    cell, results = table_5_cell(), []
    for name, bounds in bounds_sets(cell).items():
        bounded = with_bounds(cell, bounds)
        limits = np.zeros(16)
        for i, bounds_of_parameter in bounds.items():
            limits[i] = bounds_of_parameter.limit
        results += [_measure(bounded, name, c_rate, limits) for c_rate in C_RATES]
    return tuple(results)


def _measure(cell: CellModel, name: str, c_rate: float, limits: Floats) -> RunResult:
    """Run the observer from full to empty at ``c_rate``; ``limits`` has the limits of a1..a12 at index 1..12."""
    current_a = c_rate * cell.cell.capacity_ah
    samples = discharge(cell, current_a, 3600.0 / c_rate / SAMPLES)
    estimator = Estimator(
        cell, observer_settings("improved"), identifier=None, voltage_resolution_v=IDEAL_RESOLUTION_V, initial_soc=1.0
    )
    run = adaptive_run(estimator, samples)
    evaluated = (run.time_s >= SETTLED_FROM_S) & (run.time_s <= run.window.t_unst_s)
    return RunResult(
        bounds=name,
        c_rate=c_rate,
        tracking_v=float(np.abs(run.error_v[evaluated]).max()),
        error_percent=_product_errors(run.average, cell.a),
        limit_percent=_product_errors(limits, cell.a),
    )


def _product_errors(a: Floats, true_a: Floats) -> tuple[float, float]:
    return mean_error_percent(PRODUCTS[0], a, true_a), mean_error_percent(PRODUCTS[1], a, true_a)
