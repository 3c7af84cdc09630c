"""Tables of samples: status and cell voltages that a live source reported survive."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.arrays import SAMPLE, SampleStatus
from bms_estimator.model.columns import cell_voltage_columns
from bms_estimator.sinks.trace_file import join_columns, table_sink
from bms_estimator.sources.captures.replay import load_capture, open_capture


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet"])
def test_a_table_of_samples_keeps_their_status(tmp_path: Path, suffix: str) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    samples = np.zeros(4, dtype=SAMPLE)
    samples["time_s"], samples["voltage_v"] = np.arange(4.0), 3.7
    samples["temperature_c"] = [25.0, np.nan, 25.0, 25.0]
    samples["status"] = [0, SampleStatus.VOLTAGE_HELD, SampleStatus.CURRENT_SATURATED, SampleStatus.VOLTAGE_HELD]
    with table_sink(tmp_path / f"pack{suffix}") as sink:
        sink.write(samples)
    rows = load_capture(tmp_path / f"pack{suffix}").rows
    for name in SAMPLE.names or ():  # the bytes between the fields are not defined
        np.testing.assert_array_equal(rows[name], samples[name])


def test_the_status_of_another_table_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "tester.csv"
    path.write_text(
        "time_s,step,current_a,voltage_v,temperature_c,status\n0,1,0.5,3.7,25,discharge\n1,1,0.5,3.7,25,1\n"
    )
    assert load_capture(path).rows["status"].tolist() == [0, 0]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_of_samples_keeps_cell_voltages_and_status(tmp_path: Path, suffix: str) -> None:
    samples, path = np.zeros(3, dtype=SAMPLE), tmp_path / f"pack{suffix}"
    samples["time_s"], samples["voltage_v"] = np.arange(3.0), 11.1
    samples["status"] = SampleStatus.VOLTAGE_HELD
    cells_v = np.array([[3.701, 3.702, 3.697], [np.nan, 3.7, 3.7], [np.nan] * 3])
    with table_sink(path) as sink:
        sink.write(join_columns(samples, cell_voltage_columns(cells_v, 3, 3)))
    capture = open_capture(path)
    (rows,) = capture
    np.testing.assert_array_equal(capture.cells, cells_v)
    np.testing.assert_array_equal(rows["status"], samples["status"])


def test_cell_columns_after_a_missing_number_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "pack.csv"
    path.write_text("time_s,cell_2_v,current_a,voltage_v,cell_1_v,cell_4_v\n0,3.6,0.5,7.3,3.7,1\n")
    capture = open_capture(path)
    assert [rows["voltage_v"].tolist() for rows in capture] == [[7.3]]
    assert capture.cells.tolist() == [[3.7, 3.6]]
