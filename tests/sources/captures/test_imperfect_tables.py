"""Tables with parts that cannot be read: a last row that is cut off, an optional column, no header, restarts of the tester."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.columns import Columns
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.sources.captures.cycler_exports import biologic, durations, measure, novonix, text
from tests.sources.captures.test_dialects import assert_is_the_measurement

M = measure()


def load(path: Path, content: str, **options: object) -> Columns:
    """Return the capture of a table with this text."""
    path.write_text(content)
    return load_capture(path, **options)


@pytest.mark.parametrize("header", ["time_s,current_a,voltage_v", "Time,Current,Voltage"])
def test_a_last_row_that_is_cut_off_is_a_warning(header: str, tmp_path: Path) -> None:
    capture = load(tmp_path / "cell.csv", f"{header}\n0,1,3.7\n1,1,3.6\n2,1")
    assert capture["time_s"].tolist() == [0.0, 1.0]
    assert capture.warning == "line 4: 2 values, but the header has 3 columns: the last row is cut off, and not used"


def test_blocks_after_restarts_of_the_tester_are_read_in_order(tmp_path: Path) -> None:
    content = novonix(M)
    restarted = content.replace("03/12/2024 11:59", "03/13/2024 02:59").replace("03/13/2024 12:", "03/13/2024 03:")
    capture = load(tmp_path / "cell.csv", content + restarted.replace("PM", "AM"))
    np.testing.assert_allclose(capture["time_s"], np.concatenate([M.time_s, M.time_s + 3 * 3600.0]), atol=1e-5)
    np.testing.assert_array_equal(capture["current_a"], np.tile(M.current_a, 2))


@pytest.mark.parametrize("header", ["Temperature [bar]", "Temperature/%"])
def test_an_unknown_unit_of_the_temperature_costs_only_this_column(header: str, tmp_path: Path) -> None:
    capture = load(tmp_path / "cell.csv", f"Time [s],Current [A],Voltage [V],{header}\n0,1,3,25\n1,1,2.9,25\n")
    assert capture["voltage_v"].tolist() == [3.0, 2.9]
    assert np.isnan(capture["temperature_c"]).all()


def test_an_unknown_unit_in_a_row_of_units_costs_only_the_temperature(tmp_path: Path) -> None:
    content = "Time,Current,Voltage,Temperature\n,mA,V,furlong\n0,1000,3,25\n1,1000,2.9,25\n"
    capture = load(tmp_path / "cell.csv", content, current_sign="discharge_positive")
    assert capture["current_a"].tolist() == [1.0, 1.0]
    assert np.isnan(capture["temperature_c"]).all()
    with pytest.raises(UserError, match="'furlong' is not a unit of voltage"):
        load(tmp_path / "cell.csv", content.replace("V,furlong", "furlong,"))


def test_a_degree_sign_that_was_lost_is_accepted(tmp_path: Path) -> None:
    content = "time/s,Ewe/V,<I>/mA,Temperature/\ufffdC\n0,3,-1000,25\n"
    assert load(tmp_path / "cell.csv", content)["temperature_c"].tolist() == [25.0]


@pytest.mark.parametrize(
    ("header", "expected_c"),
    [("Time,Current,Voltage,Temperature", np.nan), ("time_s,current_a,voltage_v,temperature_c", 0.0)],
)
def test_zero_in_each_row_is_no_temperature_in_tables_of_other_programs(
    header: str, expected_c: float, tmp_path: Path
) -> None:
    rows = "0,1,3.7,0\n1,1,3.6,0.0\n"
    capture = load(tmp_path / "cell.csv", f"{header}\n{rows}")
    np.testing.assert_array_equal(capture["temperature_c"], expected_c)
    mapped = load_capture(tmp_path / "cell.csv", column_map={"temperature": header.rpartition(",")[2]})
    assert (mapped["temperature_c"] == 0.0).all()
    with_value = load(tmp_path / "cell.csv", f"{header}\n{rows}2,1,3.5,0.1\n")
    assert with_value["temperature_c"].tolist() == [0.0, 0.0, 0.1]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_file_without_header_is_an_error_that_says_what_to_add(separator: str, tmp_path: Path) -> None:
    rows = text(zip(["$1"] * 3, range(3), [3.7] * 3, [-4.0] * 3, [19160] * 3, strict=True), separator)
    with pytest.raises(
        UserError, match=r"no line names the columns: add one above \$1, 0, .* 5 columns, such as time_s"
    ):
        load(tmp_path / "log.txt", f"@Model: charger\n\n{rows}")


def test_an_export_without_current_is_an_error_that_says_so(tmp_path: Path) -> None:
    content = biologic(M).replace("\t<I>/mA", "\tdQ/mA.h")
    with pytest.raises(
        UserError, match=r"no column of current in this export of BioLogic; found mode, ox/red, .*Ewe/V"
    ):
        load(tmp_path / "cell.mpt", content)


def test_a_column_without_name_that_numbers_the_rows_is_ignored(tmp_path: Path) -> None:
    rows = text(zip(range(M.step.size), durations(M), M.charge_a, M.voltage_v, strict=True))
    capture = load(tmp_path / "cell.csv", ",Time,Current,Voltage\n" + rows)
    assert_is_the_measurement(capture, has_temperature=False)


@pytest.mark.parametrize("missing", ["-", "--", "N/A", "null", "unavailable"])
def test_marks_of_a_missing_value_are_no_error(missing: str, tmp_path: Path) -> None:
    capture = load(tmp_path / "cell.csv", f"time_s,current_a,voltage_v\n0,1,3.7\n1,{missing},3.6\n2,1,{missing}\n")
    assert np.isnan(capture["current_a"]).tolist() == [False, True, False]
    assert np.isnan(capture["voltage_v"]).tolist() == [False, False, True]


def test_unknown_names_above_the_numbers_are_shown(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"the columns a, b, c have none of the known names: name them by --map"):
        load(tmp_path / "cell.csv", "a,b,c\n0,1,3.7\n1,1,3.6\n")


def test_a_number_with_its_unit_is_an_error_that_says_where_the_unit_belongs(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"line 2: Current = '2\.5 A': must be a number without its unit, .* \[A\]"):
        load(tmp_path / "cell.csv", "Time,Current,Voltage\n0,2.5 A,3.7 V\n1,850 mA,3.7 V\n")


def test_json_with_one_object_in_each_line_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    line = '{"time": 1700000000, "voltage": 13.1, "current": 2}\n'
    with pytest.raises(UserError, match="JSON with one object in each line: convert it to a table"):
        load(tmp_path / "log.jsonl", 2 * line)
