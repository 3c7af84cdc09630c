"""Fit of two RC pairs with constant elements by PyBOP, as in its examples."""

import numpy as np
import pybamm
import pybop

from bms_estimator.calibration.cleaning.rests import soc_by_counting
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock

LOWEST_SOC = 0.1
"""SOC below which samples are not used."""
MAX_INITIAL_SOC = 1.0 - 1e-3
"""Maximum initial SOC. At an SOC nearer to 1 the current noise at rest would end the simulation."""
BOUND_FACTOR = 4.0
"""Ratio of upper bound to initial value, and of initial value to lower bound, as for the observer's parameters."""
UNREACHED_V = 1e3
"""Cut-off voltage that no simulation reaches, even with the extreme values that the optimizer tries [V]."""
CHANGE_C = 0.02
"""Minimum change of the current before and after which the rows are always used [C-rate]."""
EVERY_S = 10.0
"""Maximum interval between used rows [s]."""
MAX_ROWS = 7_000
"""Maximum number of rows. A fit to more rows takes more than about a minute."""


def thin_out(samples: SampleBlock, change_a: float) -> SampleBlock:
    """Return about a tenth of the rows of a test at 1 Hz, with all steps of the current by more than ``change_a``.

    A fit to these rows takes one minute instead of five.
    """
    changed = np.abs(np.diff(samples["current_a"])) > change_a
    is_used = np.concatenate([[True], changed]) | np.concatenate([changed, [True]])
    is_used |= np.diff(samples["time_s"] // EVERY_S, prepend=-1.0) > 0.0
    return samples[is_used]


def fit(
    cell: CellModel, samples: SampleBlock, initial_soc: float, start: dict[str, float], seed: int
) -> tuple[float, float, float, float, float] | None:
    """Fit R_s, R_1 [ohm], C_1 [F], R_2 [ohm], C_2 [F] by least squares to a capture that begins at rest.

    Samples below SOC 0.1 are not used, because constant elements cannot describe them.

    Args:
        cell: Capacity, limits and OCV.
        samples: Samples of the capture.
        initial_soc: SOC at the first sample.
        start: Initial elements by their names in PyBOP.
        seed: Seed of the random numbers that CMA-ES draws.

    Returns:
        None if the fit would take more than about a minute, because a capture without long rests or steps has many rows.
    """
    soc = soc_by_counting(samples, cell.cell.capacity_ah, initial_soc)
    samples = thin_out(samples[soc > LOWEST_SOC], CHANGE_C * cell.cell.capacity_ah)
    if samples.size > MAX_ROWS:
        return None
    ocv_v = ocv_grid(cell)[0]
    grid = np.linspace(0.0, 1.0, ocv_v.size)
    model = pybamm.equivalent_circuit.Thevenin(options={"number of rc elements": 2})
    values = model.default_parameter_values.copy()
    values.update(
        {
            "Initial SoC": min(initial_soc, MAX_INITIAL_SOC),
            "Cell capacity [A.h]": cell.cell.capacity_ah,
            "Nominal cell capacity [A.h]": cell.cell.capacity_ah,
            "Upper voltage cut-off [V]": UNREACHED_V,
            "Lower voltage cut-off [V]": -UNREACHED_V,
            "Open-circuit voltage [V]": lambda soc: pybamm.Interpolant(grid, ocv_v, soc),
            "Element-1 initial overpotential [V]": 0.0,
            "Element-2 initial overpotential [V]": 0.0,
            "Entropic change [V/K]": 0.0,
        }
        | {
            name: pybop.Parameter(
                initial_value=value,
                bounds=[value / BOUND_FACTOR, BOUND_FACTOR * value],
                transformation=pybop.LogTransformation(),
            )
            for name, value in start.items()
        },
        check_already_exists=False,
    )
    dataset = pybop.Dataset(
        {
            "Time [s]": samples["time_s"] - samples["time_s"][0],
            "Current [A]": np.ascontiguousarray(samples["current_a"]),
            "Voltage [V]": np.ascontiguousarray(samples["voltage_v"]),
        }
    )
    solver = pybamm.IDAKLUSolver(  # the solver that PyBOP recommends skips short pulses
        atol=1e-6, rtol=1e-6, on_failure="ignore", options={"dt_max": EVERY_S}
    )
    problem = pybop.Problem(
        pybop.pybamm.Simulator(model, parameter_values=values, protocol=dataset, solver=solver),
        pybop.SumSquaredError(dataset),
    )
    np.random.seed(seed)  # noqa: NPY002 - pints draws the seed of CMA-ES from this generator
    result = pybop.CMAES(problem, options=pybop.PintsOptions(max_iterations=100)).run()
    best = result.best_inputs
    return tuple(float(best[name]) for name in ("R0 [Ohm]", "R1 [Ohm]", "C1 [F]", "R2 [Ohm]", "C2 [F]"))  # type: ignore[return-value]
