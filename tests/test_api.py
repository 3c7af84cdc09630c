"""Public Python interface: its documentation, import time, names, and captures from tables in memory."""

import doctest
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bms_estimator
from bms_estimator.model.errors import UserError
from tests.patience import LONG_S

ROOT = Path(__file__).parents[1]


def test_the_examples_of_the_documentation_are_correct(monkeypatch, tmp_path):
    pytest.importorskip("pandas", reason="pandas is not installed: docs/reference/python.md makes a DataFrame")
    (tmp_path / "tests").symlink_to(
        ROOT / "tests"
    )  # the examples read tests/data, and write files to the current folder
    monkeypatch.chdir(tmp_path)
    failed, attempted = doctest.testfile(str(ROOT / "docs" / "reference" / "python.md"), module_relative=False)
    assert failed == 0
    assert attempted > 20, "the page has lost examples"


@pytest.mark.parametrize(
    "program", ["import bms_estimator", "from bms_estimator.cli.main import main; main(['--help'])"]
)
def test_importing_the_package_and_printing_help_do_not_import_numba(program):
    script = f"import atexit, sys; atexit.register(lambda: print('numba' in sys.modules, file=sys.stderr)); {program}"
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, timeout=LONG_S, check=True, text=True)
    assert process.stderr == "False\n"


def test_every_public_name_exists():
    assert dir(bms_estimator) == sorted(bms_estimator.__all__)
    assert all(getattr(bms_estimator, name) is not None for name in bms_estimator.__all__)
    with pytest.raises(AttributeError, match="module 'bms_estimator' has no attribute 'estimates'"):
        bms_estimator.estimates  # noqa: B018 - the access must fail


def test_an_estimator_identifies_parameters_unless_the_identifier_is_disabled():
    cell = bms_estimator.load_cell("leaf")
    assert bms_estimator.Estimator(cell).has_filter
    assert not bms_estimator.Estimator(cell, identifier=None).has_filter


def test_load_capture_accepts_a_table_and_rejects_it_like_a_file(data):
    capture = bms_estimator.load_capture(data / "lgm50" / "rate_0p5c_25c.csv.gz")
    # the test of the documentation imports pandas if it is installed; otherwise a dict is the table
    from_table = bms_estimator.load_capture(capture.to_pandas() if "pandas" in sys.modules else dict(capture))
    assert np.array_equal(from_table.rows, capture.rows)
    bdf = {
        "Test Time / s": capture["time_s"],
        "Current / A": -capture["current_a"],
        "Voltage / V": capture["voltage_v"],
    }
    assert np.array_equal(bms_estimator.load_capture(bdf)["current_a"], capture["current_a"])
    with pytest.raises(UserError, match="the table: no column of voltage; found time_s, current_a"):
        bms_estimator.load_capture({"time_s": [0.0], "current_a": [0.0]})
    with pytest.raises(UserError, match="current_sign = 'charge': must be one of discharge_positive, charge_positive"):
        bms_estimator.load_capture(bdf, current_sign="charge")


def test_a_missing_column_raises_a_key_error_with_the_existing_columns(data):
    capture = bms_estimator.load_capture(data / "lgm50" / "rate_0p5c_25c.csv.gz")
    assert "soc" not in capture
    with pytest.raises(KeyError, match="soc: no such column; there are time_s, current_a"):
        capture["soc"]
