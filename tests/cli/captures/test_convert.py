"""``convert``: captures as CSV, Parquet and Battery Data Format."""

import numpy as np
import pytest
from pyarrow import parquet

from bms_estimator.sources.captures.replay import load_capture
from tests.command_line import error, run
from tests.telemetry.alarm_captures import Line, record


@pytest.fixture
def board(data):
    """Return a raw capture whose first sample has no temperature."""
    return data / "simulated" / "board_0_1_0.bms"


@pytest.mark.parametrize("name", ["out.csv", "out.csv.gz", "out.parquet"])
def test_our_columns_restore_the_samples_exactly(capsys, tmp_path, board, name):
    out = tmp_path / name
    assert run(capsys, "convert", board, "--out", out) == (0, f"{out}: 600 samples\n", "")
    before, after = load_capture(board), load_capture(out)
    assert all(np.array_equal(after[column], before[column], equal_nan=True) for column in before)


@pytest.mark.parametrize(
    "text",
    ["time_s,current_a,voltage_v\n0.0,1.0,3.6\n", "time_s,current_a,voltage_v,temperature_c\n0.0,1.0,3.6,25.0\n"],
)
def test_columns_without_values_are_omitted(capsys, tmp_path, text):
    (tmp_path / "in.csv").write_text(text)
    assert run(capsys, "convert", tmp_path / "in.csv", "--out", tmp_path / "out.csv")[0] == 0
    assert (tmp_path / "out.csv").read_text() == text


@pytest.mark.parametrize("name", ["out.csv", "out.parquet"])
@pytest.mark.parametrize("coldest_c", [24.0, -30.0])
def test_the_extremes_of_several_probes_are_restored_exactly(capsys, tmp_path, name, coldest_c):
    line = Line(5, temperatures_c=(25.0, coldest_c, 61.0))  # an open probe sets a bit of the status
    capture, out = record(tmp_path / "probes.bms", [line]), tmp_path / name
    assert run(capsys, "convert", capture, "--out", out)[0] == 0
    before, after = load_capture(capture), load_capture(out)
    assert set(before["temperature_max_c"]) == {61.0}
    assert all(np.array_equal(after[column], before[column], equal_nan=True) for column in before)


@pytest.mark.parametrize("name", ["out.bdf", "out.bdf.gz", "out.bdf.csv", "out.bdf.csv.gz", "out.bdf.parquet"])
def test_battery_data_format_restores_the_samples_from_time_zero(capsys, tmp_path, board, name):
    out = tmp_path / name
    assert run(capsys, "convert", board, "--out", out) == (0, f"{out}: 600 samples\n", "")
    before, after = load_capture(board), load_capture(out)
    assert after["time_s"] == pytest.approx(before["time_s"] - before["time_s"][0], abs=1e-6)
    for column in ("current_a", "voltage_v", "temperature_c"):
        assert np.array_equal(after[column], before[column], equal_nan=True)


def test_battery_data_format_has_preferred_labels_charge_positive_current_and_empty_cells(capsys, tmp_path, board):
    run(capsys, "convert", board, "--out", tmp_path / "out.bdf")
    header, first = (tmp_path / "out.bdf").read_text().splitlines()[:2]
    assert header == "Test Time / s,Voltage / V,Current / A,Surface Temperature / degC"
    capture = load_capture(board)
    assert first == f"0.0,{capture['voltage_v'][0]},{-capture['current_a'][0]},"


def test_battery_data_format_has_no_temperature_column_without_a_sensor(capsys, tmp_path, data):
    run(capsys, "convert", data / "leaf" / "cc_1c.csv.gz", "--out", tmp_path / "out.bdf.parquet")
    columns = parquet.read_schema(tmp_path / "out.bdf.parquet").names
    assert columns == ["Test Time / s", "Voltage / V", "Current / A"]


def test_battery_data_format_keeps_unix_times(capsys, tmp_path):
    (tmp_path / "unix.csv").write_text("time_s,current_a,voltage_v\n1750000000.5,0,3.7\n1750000001.5,1,3.6\n")
    run(capsys, "convert", tmp_path / "unix.csv", "--out", tmp_path / "out.bdf.csv")
    assert (tmp_path / "out.bdf.csv").read_text().splitlines() == [
        "Test Time / s,Voltage / V,Current / A,Unix Time / s",
        "0.0,3.7,0.0,1750000000.5",
        "1.0,3.6,-1.0,1750000001.5",
    ]


def test_the_export_of_a_cycler_is_converted_with_a_note_on_what_was_guessed(capsys, tmp_path, data):
    out = tmp_path / "out.bdf.csv"
    code, text, err = run(capsys, "convert", data / "fuzz" / "export" / "seed-neware_record", "--out", out)
    assert code == 0
    assert err.startswith("seed-neware_record: read as Neware")
    assert text == f"{out}: {len(out.read_text().splitlines()) - 1} samples\n"
    assert np.array_equal(
        load_capture(out)["current_a"], load_capture(data / "fuzz" / "export" / "seed-neware_record")["current_a"]
    )


def test_an_unknown_suffix_is_an_error_that_lists_the_known_ones(capsys, tmp_path, board):
    err = error(run(capsys, "convert", board, "--out", tmp_path / "out.xyz"))
    assert err.startswith(
        f"error: --out {tmp_path / 'out.xyz'}: the name must end in .csv, .csv.gz or .parquet; Battery Data"
    )


def test_a_missing_capture_is_an_error(capsys, tmp_path):
    code, _, err = run(capsys, "convert", tmp_path / "none.csv", "--out", tmp_path / "out.csv")
    assert (code, err) == (2, f"error: {tmp_path / 'none.csv'}: no such file\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["convert", "validate"])
def test_steps_back_and_gaps_of_the_time_are_printed(
    command: str, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cell.csv"
    times_s = [*range(40), *range(38, 80), *range(4000, 4020)]
    path.write_text("time_s,current_a,voltage_v\n" + "".join(f"{time_s},{time_s % 3},3.7\n" for time_s in times_s))
    arguments = ["--out", tmp_path / "out.csv"] if command == "convert" else ["--cell", "ncr18650", "--soc", "0.5"]
    code, _, err = run(capsys, command, path, *arguments)
    assert code == 0, err
    assert "warning: cell.csv: steps back in time: 1, the first from 39 to 38 s" in err
    assert "warning: cell.csv: gaps without samples: 1, the longest of 3921 s after 79 s" in err
