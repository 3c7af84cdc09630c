"""Response of the thesis's observer, (3.1)-(3.3), to a constant current with true parameters, for errata 15, 16 and 27.

x2 and x3 are the voltages of the RC pairs of the cell, x2^ and x3^ the voltages of the RC pairs of the observer. e is the
error of the observer, N its gain. Both RC pairs of the observer are driven by one input u, but the RC pairs of the cell by
i/C_ts and i/C_tl. If x2^ and x3^ change slowly, u = x2^/tau_ts = x3^/tau_tl. Therefore x2^ : x3^ is tau_ts : tau_tl in the
observer, but x2 : x3 is R_ts : R_tl in the cell. Since u = -N e is not zero, e is not zero either.
"""

from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model.chen_mora import c_tl, c_ts, cell_step, r_s, r_tl, r_ts, terminal_voltage
from bms_estimator.model.cell import Bounds, CellModel
from bms_estimator.reports.thesis.simulation import IDEAL_RESOLUTION_V, observer_settings, to_samples, with_bounds

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
