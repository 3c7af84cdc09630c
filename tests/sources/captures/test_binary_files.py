"""Spreadsheets, Parquet and binary files of cyclers become the same samples as text."""

from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from tests.sources.captures.binary_exports import arbin_sheets, write_mpr, write_nda, write_xlsx
from tests.sources.captures.cycler_exports import measure
from tests.sources.captures.test_dialects import assert_is_the_measurement


@pytest.mark.parametrize("name", ["cell.nda", "stdin"])
def test_neware_file_is_read(name: str, tmp_path: Path) -> None:
    pytest.importorskip("fastnda")
    write_nda(tmp_path / name, measure())
    capture = load_capture(tmp_path / name)
    assert_is_the_measurement(capture, has_temperature=False)
    assert capture.note.startswith("read as Neware (Neware .nda)")


def test_biologic_file_is_read(tmp_path: Path) -> None:
    pytest.importorskip("galvani")
    write_mpr(tmp_path / "cell.mpr", measure())
    capture = load_capture(tmp_path / "cell.mpr")
    assert_is_the_measurement(capture, has_temperature=False)
    assert capture.note.startswith("read as BioLogic (BioLogic .mpr)")


def test_sheets_with_samples_of_an_arbin_workbook_are_joined(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    write_xlsx(tmp_path / "cell.xlsx", arbin_sheets(measure()))
    capture = load_capture(tmp_path / "cell.xlsx")
    assert_is_the_measurement(capture, has_temperature=False)
    assert capture.note.startswith("read as Arbin (sheet Channel_1-008_1, Channel_1-008_2)")


def test_one_of_several_channels_of_a_workbook_is_chosen_by_its_sheet(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    sheets = arbin_sheets(measure())
    sheets["Channel_1-009"] = sheets["Channel_1-008_1"]
    write_xlsx(tmp_path / "cell.xlsx", sheets)
    with pytest.raises(
        UserError, match=r"cell\.xlsx: several sheets have samples .*Channel_1-009.*--map sheet=Channel_1-008"
    ):
        load_capture(tmp_path / "cell.xlsx")
    with pytest.raises(UserError, match=r"no sheet Channel_2; there are .*Channel_1-009"):
        load_capture(tmp_path / "cell.xlsx", column_map={"sheet": "Channel_2"})
    both = load_capture(tmp_path / "cell.xlsx", column_map={"sheet": "Channel_1-008_1"})
    assert_is_the_measurement(both, has_temperature=False)
    other = load_capture(tmp_path / "cell.xlsx", column_map={"sheet": "Channel_1-009"})
    assert other.note.startswith("read as Arbin (sheet Channel_1-009)")


def test_invalid_time_in_a_later_block_of_parquet_is_an_error_with_its_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bms_estimator.sources.captures.tables.column_tables.BLOCK_ROWS", 2)
    columns = {"Time": ["0:00:00", "0:00:01", "0:00:02", "noon"], "Current": [1.0] * 4, "Voltage": [3.7] * 4}
    parquet.write_table(pa.table(columns), tmp_path / "cell.parquet")
    with pytest.raises(UserError, match=r"cell\.parquet: row 4: Time = 'noon': must be a duration"):
        load_capture(tmp_path / "cell.parquet")


def test_parquet_with_date_times_and_states_is_read(tmp_path: Path) -> None:
    m = measure()
    stamps = pa.array((1e6 * (m.time_s + 1.7e9)).astype("int64")).cast(pa.timestamp("us"))
    columns = {"timestamp": stamps, "Current (mA)": abs(1e3 * m.current_a), "Voltage (V)": m.voltage_v}
    columns["state"] = pa.array(m.states("discharge", "charge", "rest"))
    columns["Temperature (K)"] = m.temperature_c + 273.15
    parquet.write_table(pa.table(columns), tmp_path / "cell.parquet")
    assert_is_the_measurement(load_capture(tmp_path / "cell.parquet"), has_temperature=True)
