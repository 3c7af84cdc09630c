"""Comparison of the simulated cell with PyBaMM's Thevenin model, which has equations and a solver of its own.

Numbers in parentheses are equations of the thesis.
"""

import importlib.util
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bms_estimator.kernels.cell_model import chen_mora as kernel
from bms_estimator.model.cell import load_cell

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybamm") is None, reason="PyBaMM is not installed: it has no wheels for this machine"
)

CELL = load_cell("chen_mora")
START_SOC = 0.95
LOAD = ((0.4, 60), (0.0, 60), (-0.25, 60), (0.0, 60), (0.4, 600), (0.0, 600), (0.15, 300))
"""Currents [A], positive on discharge, and durations [s]. Some are shorter and some longer than the time constants."""
ROUNDS = 3
"""Number of repetitions of the load. They end at an SOC of 0.06, at which every element depends strongly on the SOC."""
MAX_ERROR_V = 1e-4


def constant_elements() -> np.ndarray:
    """Return the parameters of Chen and Mora's cell with all amplitudes 0, so that elements do not depend on SOC."""
    a = CELL.a.copy()
    a[[1, 4, 7, 10, 13]] = 0.0
    return a


def thevenin_voltages(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the terminal voltage [V] and SOC at each second by PyBaMM."""
    os.environ["PYBAMM_DISABLE_TELEMETRY"] = "true"  # set before the import, which would send usage data
    import pybamm  # noqa: PLC0415 - takes seconds, and only the worker that runs this test needs it

    def over_soc(amplitude: float, exponent: float, offset: float) -> Callable[..., Any]:
        """Return an element as a function of the SOC."""
        return lambda _temperature, _current, soc: amplitude * pybamm.exp(-exponent * soc) + offset

    def emf(soc: Any) -> Any:
        """Return the open-circuit voltage [V]."""
        return -a[16] * pybamm.exp(-a[17] * soc) + a[18] + a[19] * soc - a[20] * soc**2 + a[21] * soc**3  # (2.10)

    model = pybamm.equivalent_circuit.Thevenin(options={"number of rc elements": 2})
    values = model.default_parameter_values
    values.update(
        {
            "Initial SoC": START_SOC,
            "Cell capacity [A.h]": CELL.cell.capacity_ah,
            "Nominal cell capacity [A.h]": CELL.cell.capacity_ah,
            "Lower voltage cut-off [V]": 0.0,
            "Upper voltage cut-off [V]": 10.0,
            "Open-circuit voltage [V]": emf,
            "Entropic change [V/K]": lambda _ocv, _temperature: pybamm.Scalar(0.0),
            "R1 [Ohm]": over_soc(a[1], a[2], a[3]),  # (2.5)
            "R2 [Ohm]": over_soc(a[4], a[5], a[6]),  # (2.6)
            "C1 [F]": over_soc(-a[7], a[8], a[9]),  # (2.7)
            "C2 [F]": over_soc(-a[10], a[11], a[12]),  # (2.8)
            "R0 [Ohm]": over_soc(a[13], a[14], a[15]),  # (2.9)
            "Element-1 initial overpotential [V]": 0.0,
            "Element-2 initial overpotential [V]": 0.0,
        },
        check_already_exists=False,
    )
    steps = [pybamm.step.current(level, duration=seconds, period=1) for level, seconds in LOAD]
    solver = pybamm.IDAKLUSolver(rtol=1e-10, atol=1e-12)
    simulation = pybamm.Simulation(
        model, parameter_values=values, experiment=pybamm.Experiment(steps * ROUNDS), solver=solver
    )
    solution = simulation.solve(showprogress=False)
    # The last value of a step has the time of the first value of the next step, but the previous current.
    voltage_v = [cycle["Voltage [V]"].entries[:-1] for cycle in solution.cycles]
    soc = [cycle["SoC"].entries[:-1] for cycle in solution.cycles]
    return np.concatenate(voltage_v), np.concatenate(soc)


@pytest.mark.parametrize("a", [CELL.a, constant_elements()], ids=["elements over SOC", "constant elements"])
def test_simulated_cell_agrees_with_the_thevenin_model_of_pybamm(a: np.ndarray) -> None:
    """The voltages differ by at most 0.1 mV at every second of pulses and rests over most of the SOC range."""
    expected_v, expected_soc = thevenin_voltages(a)
    current_a = np.tile(np.concatenate([np.full(seconds, level) for level, seconds in LOAD]), ROUNDS)
    assert len(expected_v) == len(current_a)

    time_s = np.arange(float(len(current_a)))
    voltage_v, soc = kernel.simulate_cell((START_SOC, 0.0, 0.0), time_s, current_a, CELL.cell.capacity_ah * 3600.0, a)

    assert soc[-1] < 0.06
    assert np.abs(soc - expected_soc).max() < 1e-8
    assert np.abs(voltage_v - expected_v).max() < MAX_ERROR_V
