"""Correction of a sensor by ``[sensor]``: live samples, and samples of a recording."""

import numpy as np
import pytest

from bms_estimator.protocols.base.reading_protocol import EXACT
from bms_estimator.protocols.registry import make_protocol
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import CaptureWriter, make_header
from bms_estimator.sources.captures.replay import RawCapture

LINES = b"\n13.0,2.5\n"


def corrected(**sensor: object) -> SensorSettings:
    return SensorSettings.model_validate(
        {"protocol": "text", "voltage_gain": 1.02, "current_gain": 0.9, "current_zero_a": 0.5, **sensor}
    )


@pytest.mark.parametrize(
    ("current_sign", "current_a"), [("discharge_positive", 0.9 * (2.5 - 0.5)), ("charge_positive", -0.9 * (2.5 - 0.5))]
)
def test_gains_and_zero_are_applied_in_the_sign_of_the_device(current_sign: str, current_a: float) -> None:
    (sample,) = make_protocol(corrected(current_sign=current_sign)).feed(1.0, LINES)
    assert sample["voltage_v"] == pytest.approx(13.26)
    assert sample["current_a"] == pytest.approx(current_a)


def test_reads_at_once_are_corrected_like_single_reads() -> None:
    live, replayed = make_protocol(corrected()), make_protocol(corrected())
    data = np.frombuffer(LINES, dtype=np.uint8)
    block = live.feed(1.0, LINES)
    assert (
        block[["voltage_v", "current_a"]].tolist()
        == replayed.feed_reads(np.ones(1), np.array([data.size]), data)[["voltage_v", "current_a"]].tolist()
    )


def test_a_recording_is_replayed_with_the_correction_of_its_header(tmp_path) -> None:
    path = tmp_path / "line.bms"
    with CaptureWriter(path, make_header(corrected(current_sign="charge_positive"))) as writer:
        writer.write(1.0, LINES)
    (block,) = RawCapture(path)
    assert block["voltage_v"].item() == pytest.approx(13.26)
    assert block["current_a"].item() == pytest.approx(-1.8)


def test_default_settings_correct_nothing() -> None:
    assert SensorSettings().correction == EXACT
