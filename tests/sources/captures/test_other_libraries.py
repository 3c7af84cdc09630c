"""Cross-check with libraries: ionworksdata reads the same samples, and files that PyBaMM writes contain its solution.

ionworksdata imports PyBaMM, which has no wheels for some computers.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.sources.captures.replay import load_capture
from tests.sources.captures.cycler_exports import EXPORTS, Export

pytestmark = pytest.mark.thorough

COLUMNS = {
    "time_s": "Time [s]",
    "current_a": "Current [A]",
    "voltage_v": "Voltage [V]",
    "temperature_c": "Temperature [degC]",
}
READ_BY_BOTH = [export for export in EXPORTS if export.reader]


@pytest.fixture(scope="module")
def read():
    """Return the reading function of ionworksdata; skip if it is not installed."""
    os.environ.setdefault("PYBAMM_DISABLE_TELEMETRY", "true")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = pytest.importorskip("ionworksdata", reason="ionworksdata is not installed", exc_type=ImportError)
    return module.read.time_series


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("export", READ_BY_BOTH, ids=[export.write.__name__ for export in READ_BY_BOTH])
def test_ionworksdata_reads_the_same_samples(read, export: Export, tmp_path: Path) -> None:
    path = export.save(tmp_path)
    other, ours = read(path, reader=export.reader), load_capture(path)
    for ours_name, other_name in COLUMNS.items():
        if ours_name == "temperature_c" and not export.has_temperature:
            assert other_name not in other.columns
            continue
        np.testing.assert_allclose(ours[ours_name], other[other_name].to_numpy(), atol=1e-9, err_msg=ours_name)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("voltage", ["Terminal voltage [V]", "Voltage [V]"])
def test_file_that_pybamm_writes_contains_its_solution(read, voltage: str, tmp_path: Path) -> None:
    import pybamm  # noqa: PLC0415 - it is slow to import

    experiment = pybamm.Experiment(
        ["Rest for 1 minute", "Discharge at 1C for 2 minutes", "Charge at C/2 for 2 minutes"]
    )
    simulation = pybamm.Simulation(pybamm.lithium_ion.SPM(), experiment=experiment)
    solution = simulation.solve()
    names = ["Time [s]", "Current [A]", voltage, "Volume-averaged cell temperature [K]"]
    solution.save_data(str(tmp_path / "spm.csv"), names, to_format="csv")
    capture = load_capture(tmp_path / "spm.csv")
    for name, column in zip(("time_s", "current_a", "voltage_v"), names, strict=False):
        np.testing.assert_allclose(capture[name], solution[column].entries)
    np.testing.assert_allclose(capture["temperature_c"], 25.0)
    assert capture.note.startswith("read as PyBaMM")
    assert capture.warning == ""
