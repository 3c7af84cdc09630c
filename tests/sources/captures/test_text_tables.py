"""Text tables: lines that are not rows, units, time stamps, archives, and columns that the user names."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.calibration.cleaning.clean_capture import remove_glitches, soc_by_counting
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture, open_capture
from bms_estimator.sources.captures.tables.layout import Role
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map
from bms_estimator.sources.captures.tables.table_reader import Table
from tests.sources.captures.cycler_exports import EXPORTS, Export

HEADER = "time_s,current_a,voltage_v\n"


def load(path: Path, content: str, **options: object) -> dict[str, list[float]]:
    """Return the columns of a table with this text."""
    path.write_text(content)
    return {name: column.tolist() for name, column in load_capture(path, **options).items()}


def test_repeated_headers_empty_rows_and_a_footer_are_ignored(tmp_path: Path) -> None:
    content = f"# comment\n{HEADER}0,1,3.7\n{HEADER}1,1,3.6\n,,\n\n# comment\n2,1,3.5\nend of test,,\ntotal: 3 rows\n"
    assert load(tmp_path / "cell.csv", content)["time_s"] == [0.0, 1.0, 2.0]


def test_text_between_rows_is_an_error_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cell\.csv: line 3: 'pause': not a row of numbers, though rows follow"):
        load(tmp_path / "cell.csv", f"{HEADER}0,1,3.7\npause\n1,1,3.6\n")


def test_row_that_is_cut_off_is_an_error_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cell\.csv: line 3: 2 values, but the header has 3 columns"):
        load(tmp_path / "cell.csv", f"{HEADER}0,1,3.7\n1,1\n2,1,3.7\n")


def test_empty_cell_is_a_missing_value(tmp_path: Path) -> None:
    columns = load(tmp_path / "cell.csv", f"{HEADER}0,1,3.7\n1,,3.6\n")
    np.testing.assert_array_equal(columns["current_a"], [1.0, np.nan])


@pytest.mark.parametrize(
    ("header", "row", "expected"),
    [
        ("Time [ms],Current [µA],Voltage [mV],Temperature [K]", "1500,2e6,3700,298.15", (1.5, 2.0, 3.7, 25.0)),
        ("Time (min),Current (mA),Voltage (V),Temperature (°F)", "1.5,2000,3.7,77", (90.0, 2.0, 3.7, 25.0)),
        ("time/h,I/mA,U/V,Temp/degC", "0.5,2000,3.7,25", (1800.0, 2.0, 3.7, 25.0)),
        ("Time,Current,Voltage,Temperature", "26:00:01.5,2,3.7,25", (93_601.5, 2.0, 3.7, 25.0)),
        ("Time,Current,Voltage,Temperature", "1d 02:00:01.5,2,3.7,25", (93_601.5, 2.0, 3.7, 25.0)),
    ],
)
def test_units_become_seconds_amperes_volts_and_degrees(
    header: str, row: str, expected: tuple[float, ...], tmp_path: Path
) -> None:
    columns = load(tmp_path / "cell.csv", f"{header}\n{row}\n", current_sign="discharge_positive")
    values = (columns[name][0] for name in ("time_s", "current_a", "voltage_v", "temperature_c"))
    assert tuple(values) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2024-03-12 23:59:59.5", "2024-03-13 00:00:01.5"),
        ("2024-03-12T23:59:59.500+01:00", "2024-03-12T23:00:01.500+00:00"),
        ("03/12/2024 11:59:59.5 PM", "03/13/2024 12:00:01.5 AM"),
        ("13/03/2024 23:59:59", "14/03/2024 00:00:01"),
        ("12.03.2024 23:59:59,5", "13.03.2024 00:00:01,5"),
    ],
)
def test_date_times_become_seconds_since_the_first(first: str, second: str, tmp_path: Path) -> None:
    columns = load(tmp_path / "cell.csv", f"Timestamp;Current;Voltage\n{first};0;3\n{second};1;3\n")
    assert columns["time_s"] == pytest.approx([0.0, 2.0])


def test_unknown_unit_is_an_error_that_names_the_column(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"column Voltage \[bar\]: 'bar' is not a unit of voltage .*--map"):
        load(tmp_path / "cell.csv", "Time [s],Current [A],Voltage [bar]\n0,1,3\n")


def test_two_columns_of_a_quantity_are_an_error_that_names_both(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"Voltage\(V\) and Voltage\(mV\): choose one of these columns by --map"):
        load(tmp_path / "cell.csv", "Time,Current,Voltage(V),Voltage(mV)\n0,1,3,3000\n")


def test_columns_that_the_user_names_are_read_with_their_units(tmp_path: Path) -> None:
    content = "Report\nt [min];load, in use [mA];U1 [V];U2 [V]\n1;1500;3.7;3.8\n"
    column_map = parse_column_map("time=t [min],current=load, in use [mA],voltage=U2 [V]")
    columns = load(tmp_path / "cell.csv", content, column_map=column_map, current_sign="discharge_positive")
    assert (columns["time_s"], columns["current_a"], columns["voltage_v"]) == ([60.0], [1.5], [3.8])


@pytest.mark.parametrize("text", ["", "time", "time=t,voltage=", "time=t,current=i,current=j", "charge=q"])
def test_invalid_map_is_rejected_with_its_form(text: str) -> None:
    with pytest.raises(UserError, match=r"--map .*: must be one or more of time=COLUMN,current=COLUMN,voltage=COLUMN"):
        parse_column_map(text)


@pytest.mark.parametrize("export", EXPORTS, ids=[export.write.__name__ for export in EXPORTS])
def test_a_map_of_one_column_keeps_what_the_format_defines_for_the_others(export: Export, tmp_path: Path) -> None:
    path = export.save(tmp_path)
    capture = open_capture(path)
    assert isinstance(capture, Table)
    columns = {role: column.name for role, column in capture.layout.columns.items()}
    for role in (Role.TIME, Role.CURRENT, Role.VOLTAGE):
        mapped = load_capture(path, column_map={role.value: columns[role]})
        for name, column in load_capture(path).items():
            np.testing.assert_array_equal(mapped[name], column, err_msg=f"{role}: {name}")
        assert "given columns (" in mapped.note


def test_a_given_name_may_be_followed_by_a_unit(tmp_path: Path) -> None:
    column_map = parse_column_map("time=Time [ms],current=Load (raw) [mA]")
    content = "Time,Load (raw),Voltage\n0,1500,3.7\n2000,1500,3.6\n"
    columns = load(tmp_path / "cell.csv", content, column_map=column_map, current_sign="discharge_positive")
    assert (columns["time_s"], columns["current_a"]) == ([0.0, 2.0], [1.5, 1.5])


def test_a_map_may_name_only_the_sheet() -> None:
    assert parse_column_map("sheet=Channel 1, cell 2") == {"sheet": "Channel 1, cell 2"}


def test_a_sheet_of_a_text_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"sheet Data is given, but the file is not a spreadsheet"):
        load(tmp_path / "cell.csv", HEADER + "0,0,3.7\n", column_map={"sheet": "Data"})


def test_both_rows_of_a_step_of_a_cycler_count_in_the_charge(tmp_path: Path) -> None:
    rows = (
        "0,0,4.1\n60,0,4.1\n60,-2,4.0\n120,-2,3.9\n120,0,4.0\n120,0,4.0\n180,0,4.0\n240,0,4.0\n240,-2,3.9\n300,-2,3.8\n"
    )
    path = tmp_path / "cell.csv"
    path.write_text(f"Test Time (s),Current (A),Voltage (V)\n{rows}")
    good = remove_glitches(load_capture(path).rows, "cell")
    assert soc_by_counting(good, capacity_ah=1.0)[-1] == pytest.approx(1.0 - 2 * 120 / 3600, abs=1e-8)


def test_equal_times_in_a_table_of_this_project_stay_equal(tmp_path: Path) -> None:
    columns = load(tmp_path / "cell.csv", HEADER + "0,0,3.7\n60,0,3.7\n60,2,3.6\n")
    assert columns["time_s"] == [0.0, 60.0, 60.0]


def test_archive_with_several_files_is_an_error_that_names_them(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "cell.zip", "w") as archive:
        archive.writestr("a.csv", HEADER)
        archive.writestr("b.csv", HEADER)
    with pytest.raises(UserError, match=r"cell\.zip: the archive must contain one file, but has 2: a\.csv, b\.csv"):
        load_capture(tmp_path / "cell.zip")


def test_rows_beyond_a_block_are_read_like_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bms_estimator.sources.captures.tables.text_table.BLOCK_ROWS", 7)
    for export in EXPORTS:
        path = export.save(tmp_path)
        in_blocks = load_capture(path)
        with monkeypatch.context() as unpatched:
            unpatched.setattr("bms_estimator.sources.captures.tables.text_table.BLOCK_ROWS", 1000)
            at_once = load_capture(path)
        for name, column in in_blocks.items():
            np.testing.assert_array_equal(column, at_once[name], err_msg=f"{path.name}: {name}")


def test_pipe_is_rejected_with_a_remedy(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="is a pipe or a device; give - and redirect it to standard input"):
        open_capture(tmp_path / "pipe")


@pytest.mark.parametrize(("group", "comma"), [(".", ","), ("\u202f", ","), ("'", "."), (" ", ",")])
def test_groups_of_digits_are_read(group: str, comma: str, tmp_path: Path) -> None:
    marks = str.maketrans(",.", group + comma)
    rows = [
        [f"{value:,.1f}".translate(marks) for value in (1_000.0 + second, 3_650.5, 12_000.0)] for second in range(9)
    ]
    path = tmp_path / "log.csv"
    path.write_text("Time (s);Voltage (mV);Current (mA)\n" + "".join(";".join(row) + "\n" for row in rows), "utf-8")
    capture = load_capture(path, current_sign="discharge_positive")
    assert capture["time_s"].tolist() == [1_000.0 + second for second in range(9)]
    np.testing.assert_allclose(capture["voltage_v"], 3.6505)
    np.testing.assert_allclose(capture["current_a"], 12.0)


def test_columns_of_the_battery_precede_those_of_the_grid(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "time,voltage,current,battery voltage,battery_discharge_current,battery_charge_current\n0,230,1,52,4,0\n1,230,1,52,0,3\n"
    )
    capture = load_capture(path, column_map={"current": "battery_discharge_current"})
    assert capture["voltage_v"].tolist() == [52.0, 52.0]
    assert capture["current_a"].tolist() == [4.0, -3.0]


def test_a_time_that_cannot_be_read_is_an_error_that_names_the_formats(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Time,Current,Voltage\n0:30.5,1,3.7\n0:31.5,1,3.7\n")
    with pytest.raises(UserError, match=r"Time = '0:30\.5': must be a number, a duration h:m:s, or a date and time"):
        load_capture(path)
