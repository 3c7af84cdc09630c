"""PyBaMM and PyBOP with exported parameters, against the open-loop model."""

import functools
import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from bms_estimator.conversion.json_and_pybamm import pybamm_module
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from tests.conversion.load import INITIAL_SOC, STEP_S, difference_mv, load_profile

MAX_STEP_MV = 1.0
"""Maximum difference. It occurs at steps of the current, which PyBaMM and ``validate`` interpolate differently."""
MAX_EMPTY_MV = 3.0
"""Maximum difference below SOC 0.2, where the resistances rise steeply."""


@functools.cache
def pybamm() -> ModuleType:
    """Return the module. Its import takes a second, so that only the tests that use it import it."""
    return pytest.importorskip("pybamm", reason="PyBaMM has no solvers for this processor")


def nmc() -> CellModel:
    """Return a cell without hysteresis, which PyBaMM's model does not have, and with a temperature coefficient."""
    cell = load_cell("nmc", 5.0)
    assert isinstance(cell.ocv, TableOcv)
    changes = {"hysteresis_v": None, "per_kelvin_v": tuple(np.linspace(-3e-4, 2e-4, len(cell.ocv.soc)))}
    return cell.model_copy(update={"ocv": cell.ocv.model_copy(update=changes)})


def import_parameters(path: Path, cell: CellModel) -> ModuleType:
    """Write the parameters of a cell as a module, and import it."""
    file = path / "exported.py"
    file.write_text(pybamm_module(cell))
    spec = importlib.util.spec_from_file_location("exported", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def parameter_values(module: ModuleType, temperature_c: float):
    values = pybamm().ParameterValues(module.get_parameter_values())
    kelvin = temperature_c + 273.15
    values.update({"Initial SoC": INITIAL_SOC, "Ambient temperature [K]": kelvin, "Initial temperature [K]": kelvin})
    return values


def solve(module: ModuleType, time_s: Floats, current_a: Floats, temperature_c: float) -> Floats:
    """Return the voltages of PyBaMM's Thevenin model [V]."""
    values = parameter_values(module, temperature_c)
    values["Current function [A]"] = pybamm().Interpolant(time_s, current_a, pybamm().t)
    model = pybamm().equivalent_circuit.Thevenin(options=module.OPTIONS)
    simulation = pybamm().Simulation(model, parameter_values=values)
    return simulation.solve([0.0, time_s[-1]], t_interp=time_s)["Voltage [V]"](time_s)


def test_pybamm_predicts_the_voltage_of_the_rc_ladder_down_to_empty(tmp_path):
    cell = nmc()
    time_s, current_a = load_profile(cell, final_soc=0.02)
    voltage_v = solve(import_parameters(tmp_path, cell), time_s, current_a, 25.0)
    error_mv = np.abs(difference_mv(cell, time_s, current_a, voltage_v, 25.0))
    after_soc_0_2 = int(0.18 * 3600 / STEP_S)  # SOC 0.2 to 0.02 at 1C
    assert error_mv[:-after_soc_0_2].max() < MAX_STEP_MV
    assert error_mv.max() < MAX_EMPTY_MV


def test_pybamm_predicts_the_voltage_of_the_rc_ladder_in_the_cold(tmp_path):
    cell = nmc()
    time_s, current_a = load_profile(cell, final_soc=0.25)
    voltage_v = solve(import_parameters(tmp_path, cell), time_s, current_a, 10.0)
    assert (
        np.abs(difference_mv(cell, time_s, current_a, voltage_v, 10.0)).max() < 1.5 * MAX_STEP_MV
    )  # the resistances are larger


def test_pybamm_predicts_the_voltage_of_two_rc_pairs(tmp_path):
    cell = load_cell("leaf")
    time_s, current_a = load_profile(cell, final_soc=0.02)
    voltage_v = solve(import_parameters(tmp_path, cell), time_s, current_a, 25.0)
    assert np.abs(difference_mv(cell, time_s, current_a, voltage_v, 25.0)).max() < MAX_STEP_MV


def test_pybop_predicts_the_voltage_of_the_rc_ladder(tmp_path):
    pybop = pytest.importorskip("pybop", reason="PyBOP is not installed")
    cell = nmc()
    module = import_parameters(tmp_path, cell)
    time_s, current_a = load_profile(cell, final_soc=0.25)
    simulator = pybop.pybamm.Simulator(
        pybamm().equivalent_circuit.Thevenin(options=module.OPTIONS),
        parameter_values=parameter_values(module, 25.0),
        protocol=pybop.Dataset({"Time [s]": time_s, "Current [A]": current_a}),
    )
    voltage_v = simulator.solve()["Voltage [V]"].data
    assert np.abs(difference_mv(cell, time_s, current_a, voltage_v, 25.0)).max() < MAX_STEP_MV


def test_a_description_cannot_end_the_docstring(tmp_path):
    cell = load_cell("leaf")
    description = 'x""" + undefined_name + """\\'
    cell = cell.model_copy(update={"cell": cell.cell.model_copy(update={"description": description})})
    assert "undefined_name" in import_parameters(tmp_path, cell).__doc__
