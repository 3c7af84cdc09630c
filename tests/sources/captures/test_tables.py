"""Tables of samples: the status that a live source reported survives."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.sample import SAMPLE, SampleStatus
from bms_estimator.sinks.trace_file import table_sink
from bms_estimator.sources.captures.replay import load_capture


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
