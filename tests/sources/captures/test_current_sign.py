"""Sign of the current: option, state, convention of the format, settings, response of the voltage, assumption."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator import load_capture
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.replay import open_capture
from tests.sources.captures.cycler_exports import maccor, measure, text

M = measure()


def save(path: Path, header: str, current_a: object, voltage_v: object = M.voltage_v) -> Path:
    """Write a table with the measurement's times."""
    path.write_text(header + "\n" + text(zip(M.time_s, current_a, voltage_v, strict=True)))
    return path


@pytest.mark.parametrize(("factor", "direction"), [(1.0, "discharge"), (-1.0, "charge")])
def test_voltage_shows_the_sign_if_the_format_defines_none(factor: float, direction: str, tmp_path: Path) -> None:
    capture = load_capture(save(tmp_path / "cell.csv", "Time,Current,Voltage", factor * M.current_a))
    np.testing.assert_allclose(capture["current_a"], M.current_a)
    assert f"positive on {direction} (response of the voltage)" in capture.note


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_slow_discharge_without_steps_shows_the_sign(factor: float, tmp_path: Path) -> None:
    voltage_v = 4.1 - 0.005 * np.arange(M.time_s.size)
    path = save(tmp_path / "cell.csv", "Time,Current,Voltage", np.full(M.time_s.size, 0.1 * factor), voltage_v)
    assert (load_capture(path)["current_a"] == 0.1).all()


def test_discharge_is_positive_if_nothing_shows_the_sign_and_the_note_says_so(tmp_path: Path) -> None:
    capture = load_capture(save(tmp_path / "cell.csv", "Time,Current,Voltage", M.charge_a, M.voltage_v * 0.0 + 3.7))
    np.testing.assert_allclose(capture["current_a"], M.charge_a)
    assert "positive on discharge (assumed: the file does not show it; --current-sign sets it)" in capture.note


def test_settings_define_the_sign_of_a_table_without_one(tmp_path: Path) -> None:
    path = save(tmp_path / "cell.csv", "Time,Current,Voltage", M.charge_a)
    (samples,) = open_capture(path, SensorSettings(current_sign="charge_positive"))
    np.testing.assert_allclose(samples["current_a"], M.current_a)


@pytest.mark.parametrize(
    ("header", "current_a", "opposite"),
    [
        ("time_s,current_a,voltage_v", M.charge_a, "charge_positive"),
        ("test_time_second,current_ampere,voltage_volt", M.current_a, "discharge_positive"),
    ],
)
def test_contradiction_of_format_and_voltage_is_a_warning_with_a_remedy(
    header: str, current_a: object, opposite: str, tmp_path: Path
) -> None:
    path = save(tmp_path / "cell.csv", header, current_a)
    capture = load_capture(path)
    np.testing.assert_allclose(capture["current_a"], -M.current_a)  # the format decides
    assert capture.warning.endswith(f"if so, use --current-sign {opposite}")
    corrected = load_capture(path, current_sign=opposite)
    np.testing.assert_allclose(corrected["current_a"], M.current_a)
    assert corrected.warning == ""


def test_option_overrides_a_column_of_states(tmp_path: Path) -> None:
    path = tmp_path / "cell.txt"
    path.write_text(maccor(M))
    assert "signed (column Md)" in load_capture(path).note
    capture = load_capture(path, current_sign="charge_positive")
    np.testing.assert_allclose(capture["current_a"], -np.abs(M.current_a))
