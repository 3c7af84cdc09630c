"""Files of a calibration beside a pack."""

import math

import pytest

from bms_estimator.cli.cell.calibration_session import join_recordings
from bms_estimator.settings.sensor import SensorSettings


@pytest.mark.parametrize("content", [b"", bytes(4096)])
def test_a_recording_that_a_power_failure_left_without_data_does_not_prevent_a_continuation(tmp_path, content) -> None:
    path = tmp_path / "cell-1.bms"
    path.write_bytes(content)
    samples, last_arrival_s = join_recordings([path], SensorSettings())
    assert samples.size == 0
    assert math.isnan(last_arrival_s)
