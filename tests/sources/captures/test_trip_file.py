"""Trips from files: tables of time and load, and captures."""

import gzip
from pathlib import Path

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.curves import read_trip


def write(folder: Path, text: str) -> Path:
    path = folder / "trip.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "time_s,power_w\n0,100\n60,0\n90,0\n",
        "# a trip\npower_w;time_s\n100;0\n\n0;60\n0;90\n",
        "time_s;note;power_w\n0;start;100,0\n60;;0,0\n90,0;;0\n",
    ],
)
def test_table_of_power_is_a_profile(tmp_path: Path, text: str) -> None:
    trip, capture = read_trip(write(tmp_path, text))
    assert capture is None
    assert trip.load.duration_s.tolist() == [60.0, 30.0]
    assert trip.load.power_w.tolist() == [100.0, 0.0]


def test_compressed_table_of_current_is_a_profile(tmp_path: Path) -> None:
    path = tmp_path / "trip.csv.gz"
    path.write_bytes(gzip.compress(b"time_s,current_a\n0,1.5\n10,-2\n20,0\n"))
    assert read_trip(path)[0].load.current_a.tolist() == [1.5, -2.0]


def test_capture_gives_its_current_without_samples_that_are_not_usable(tmp_path: Path) -> None:
    rows = "0,1,3.7\n1,2,3.7\n1,5,3.7\nnan,5,3.7\n2,nan,3.7\n3,4,3.7\n5,0,3.7\n"
    trip, capture = read_trip(write(tmp_path, f"time_s,current_a,voltage_v\n{rows}"))
    assert capture is not None
    assert trip.load.duration_s.tolist() == [1.0, 2.0, 2.0]
    assert trip.load.current_a.tolist() == [1.0, 2.0, 4.0]


def test_columns_of_a_capture_can_be_named(tmp_path: Path) -> None:
    path = write(tmp_path, "seconds,load,u\n0,1,3.7\n9,2,3.7\n")
    trip, _ = read_trip(
        path,
        column_map={"time": "seconds", "current": "load", "voltage": "u"},
        current_sign="charge_positive",
    )
    assert trip.load.current_a.tolist() == [-1.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "time_s,voltage_v\n0,3.7\n",
            "needs time_s and exactly one of current_a and power_w; its columns are time_s, voltage_v",
        ),
        ("time_s,current_a,power_w\n0,1,2\n1,2,3\n", "exactly one of current_a and power_w"),
        ("time_s,power_w\n0,5\n1,x\n", "row 2: power_w = 'x': must be a number"),
        ("time_s,power_w\n0,5\n1\n", "row 2: 1 values, but the header has 2 columns"),
        ("time_s,power_w\n0,nan\n1,2\n", "point 1: power_w = nan: must be a number"),
        ("time_s,power_w\n5,5\n1,2\n", "point 2: time_s = 1 after 5: must increase"),
        ("time_s,power_w\n", "0 points"),
        ("hello\n", "not a capture"),
    ],
)
def test_file_without_a_usable_load_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UserError) as caught:
        read_trip(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_trip(tmp_path / "none.csv")
