"""Test of Theorem 4.1.2 of the thesis: the time constants R_ts C_ts and R_tl C_tl converge to the true values.

The theorem claims this at a small current, whatever the bounds between which the coefficients a1..a12 of these elements
are adapted. Here the observer runs at several currents and with several bounds on a simulated cell. By Lemma 4.1.3 each
a_i converges to its limit, a weighted mean of its bounds.

The response to a constant current with true parameters, by (3.1)-(3.3), serves errata 15, 16 and 27. x2 and x3
are the voltages of the RC pairs of the cell, x2^ and x3^ the voltages of the RC pairs of the observer. e is the
error of the observer, N its gain. Both RC pairs of the observer are driven by one input u, but the RC pairs of the cell by
i/C_ts and i/C_tl. If x2^ and x3^ change slowly, u = x2^/tau_ts = x3^/tau_tl. Therefore x2^ : x3^ is tau_ts : tau_tl in the
observer, but x2 : x3 is R_ts : R_tl in the cell. Since u = -N e is not zero, e is not zero either.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from bms_estimator.calibration.thesis.adaptive_run import adaptive_run
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, cell_step, r_s, r_tl, r_ts, terminal_voltage
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import Bounds
from bms_estimator.reports.thesis.simulation import (
    IDEAL_RESOLUTION_V,
    discharge,
    mean_error_percent,
    observer_settings,
    table_5_cell,
    to_samples,
    with_bounds,
)

STEP_S = 0.1
"""Simulation step [s]."""
DURATION_S = 1800.0
"""Duration of the constant current [s]: eight times tau_tl."""


@dataclass(frozen=True)
class QuasiSteady:
    """Cell and observer at the end of the constant current.

    Attributes:
        cell_v: x2 and x3 of the cell [V].
        observer_v: x2^ and x3^ [V].
        tau_s: tau_ts and tau_tl of both cell and observer [s].
        ohmic_v: i R_s, which (2.4) subtracts from the terminal voltage [V].
        driven_v: u R_s, which (3.14) subtracts instead [V ohm/s].
        error_v: Error e of the observer [V].
        predicted_v: -x2^ / (N tau_ts), the error e at which x2^ is constant [V].
    """

    cell_v: tuple[float, float]
    observer_v: tuple[float, float]
    tau_s: tuple[float, float]
    ohmic_v: float
    driven_v: float
    error_v: float
    predicted_v: float


def quasi_steady(cell: CellModel, current_a: float) -> QuasiSteady:
    """Simulate a full cell at a constant ``current_a`` [A], and the observer with the a1..a12 of the cell."""
    a, capacity_as = cell.a, cell.cell.capacity_ah * 3600.0
    cell_state = (1.0, 0.0, 0.0)
    time_s = np.arange(0.0, DURATION_S, STEP_S, dtype=np.float64)
    voltage_v = np.empty(time_s.size)
    for n in range(time_s.size):
        voltage_v[n] = terminal_voltage(cell_state, current_a, a)
        cell_state = cell_step(cell_state, current_a, STEP_S, capacity_as, a)
    # bounds whose limit is the initial, true value, so that the parameters do not change
    bounds_around_truth = {
        i: Bounds(upper=1.5 * a[i], lower=0.5 * a[i], weight_upper=50.0, weight_lower=50.0, initial=a[i])
        for i in range(1, 13)
    }
    estimator = Estimator(
        with_bounds(cell, bounds_around_truth),
        observer_settings("improved"),
        identifier=None,
        voltage_resolution_v=IDEAL_RESOLUTION_V,
        initial_soc=1.0,
    )
    estimator.run(to_samples(time_s, np.full(time_s.size, current_a), voltage_v))
    observer_state = estimator.state[0]
    r_s_ohm = r_s(cell_state[0], a)
    tau_ts, tau_tl = r_ts(cell_state[0], a) * c_ts(cell_state[0], a), r_tl(cell_state[0], a) * c_tl(cell_state[0], a)
    return QuasiSteady(
        cell_v=(cell_state[1], cell_state[2]),
        observer_v=(float(observer_state["v_ts"]), float(observer_state["v_tl"])),
        tau_s=(tau_ts, tau_tl),
        ohmic_v=current_a * r_s_ohm,
        driven_v=-float(observer_state["gain"]) * float(observer_state["innovation_v"]) * r_s_ohm,
        error_v=float(observer_state["innovation_v"]),
        predicted_v=-float(observer_state["v_ts"]) / (float(observer_state["gain"]) * tau_ts),
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
