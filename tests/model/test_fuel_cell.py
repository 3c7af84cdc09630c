"""Fuel cell files: the shipped file, scaling, invalid files, writing and reading."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.kernels.cell_model.fuel_cell import NAMES, polarisation
from bms_estimator.model.cell import is_fuel_cell, load_cell, shipped_fuel_cells
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, load_fuel_cell, load_model, write_cell
from tests import mann_stack

PEM = load_fuel_cell("pem_30w")
RATED_A = 3.25
"""Rated current of the stack [A]."""


def voltage_v(model: FuelCellModel, current_a: float) -> float:
    """Return the voltage of the polarisation curve at ``current_a`` [V]."""
    return float(polarisation(model.a, np.zeros(8), np.array([current_a]), np.array([np.nan]))[0][0])


def test_the_shipped_stack_delivers_30_w() -> None:
    assert shipped_fuel_cells() == ["pem_30w"]
    assert RATED_A * voltage_v(PEM, RATED_A) == pytest.approx(30.3, abs=0.1)
    assert voltage_v(PEM, RATED_A) == pytest.approx(PEM.cell.nominal_voltage_v, abs=0.05)


def test_the_shipped_stack_has_the_published_coefficients() -> None:
    """The resistance is that at the rated current and a water content of the membrane of 14."""
    kelvin = 273.15 + PEM.fuel_cell.temperature_c
    f, n = PEM.fuel_cell, mann_stack.CELLS
    assert f.tafel_slope_v == pytest.approx(-mann_stack.XI_4 * kelvin * n, rel=1e-3)
    assert PEM.activation_v == pytest.approx(n * mann_stack._activation_v(kelvin), rel=1e-3)
    assert f.c_dl_farad == pytest.approx(mann_stack.C_FARAD / n, rel=1e-3)
    assert f.r_ohm == pytest.approx(n * mann_stack._cell_ohm(RATED_A, kelvin, 14.0), rel=1e-3)
    assert f.concentration_v == pytest.approx(n * mann_stack.B_V)
    assert (f.limiting_current_a, f.internal_current_a) == pytest.approx((mann_stack.LIMIT_A, mann_stack.INTERNAL_A))


def test_stacks_in_series_and_parallel_share_voltage_and_current() -> None:
    assert voltage_v(PEM.pack(3, 1), 2.0) == pytest.approx(3.0 * voltage_v(PEM, 2.0))
    assert voltage_v(PEM.pack(1, 4), 8.0) == pytest.approx(voltage_v(PEM, 2.0))
    assert PEM.pack(1, 1) is PEM


def test_stacks_in_parallel_with_too_large_an_exchange_current_are_rejected() -> None:
    large = PEM.model_copy(update={"fuel_cell": PEM.fuel_cell.model_copy(update={"exchange_current_a": 0.4})})
    assert large.pack(1, 2).activation_v > 0.0
    with pytest.raises(UserError, match=r"^pem_30w: exchange_current_a of 3 in parallel is 1\.2: must be less than 1$"):
        large.pack(1, 3)


def test_a_written_file_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    a = PEM.a
    a[1 : 1 + len(NAMES)] *= 1.25  # all identified parameters
    identified = PEM.identified(a, {"r_ohm": 0.0123456})
    write_cell(path, identified, ["a remark"])
    read_back = load_model(path)
    assert read_back == identified
    assert read_back.a == pytest.approx(a, rel=1e-4)
    assert read_back.std == {"r_ohm": 0.012}  # rounded
    assert is_fuel_cell(path)


@pytest.mark.parametrize(
    ("text", "edit", "message"),
    [
        ("r_ohm = 0.1677", "r_ohm = -1", r"fuel_cell\.r_ohm = -1.*greater than 0.*membrane"),
        ("r_ohm = 0.1677", "", r"fuel_cell\.r_ohm: missing \(resistance of membrane"),
        ("oxygen_atm = 0.21", "oxygen_atm = 0.21\nhumidity = 1", r"fuel_cell\.humidity.*unknown key"),
        ("exchange_current_a = 0.000927", "exchange_current_a = 2.0", r"exchange_current_a = 2\.0.*less than 1"),
        ("[fuel_cell]", "[std]\nocv = 1.0\n[fuel_cell]", r"std\.ocv"),
        ("voltage_min_v = 2.0", "voltage_min_v = 20.0", r"must increase in this order"),
    ],
)
def test_the_error_on_an_invalid_value_names_the_key(tmp_path: Path, text: str, edit: str, message: str) -> None:
    shipped = Path(mann_stack.__file__).parents[1] / "bms_estimator/model/cells/fuel_cell/pem_30w.toml"
    path = tmp_path / "mine.toml"
    path.write_text(shipped.read_text().replace(text, edit, 1))
    with pytest.raises(UserError, match=message):
        load_fuel_cell(path)


def test_functions_for_batteries_reject_a_fuel_cell(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^pem_30w is a fuel cell, which has no state of charge"):
        load_cell("pem_30w")
    with pytest.raises(UserError, match=r"no capacity"):
        load_model("pem_30w", 3.0)
    with pytest.raises(UserError, match=r"no such cell file.*pem_30w"):
        load_fuel_cell("pem_31w")
    assert load_model("chen_mora") == load_cell("chen_mora")
