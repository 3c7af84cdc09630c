"""Sign of the current: option, state, convention of the format, settings, response of the voltage, assumption."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.replay import load_capture, open_capture
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


def cycle(rest_s: int) -> tuple[np.ndarray, np.ndarray]:
    """Return current and voltage of a discharge and a charge with 1 A, with rests of this duration, one row a second."""
    current_a = np.concatenate([np.zeros(rest_s), np.ones(600), np.zeros(rest_s), -np.ones(600), np.zeros(rest_s)])
    return current_a, 4.0 - 0.001 * np.cumsum(current_a) - 0.05 * current_a


def save_cycle(path: Path, header: str, current_a: object, voltage_v: object) -> Path:
    """Write a table with one row a second."""
    path.write_text(header + "\n" + text(zip(range(np.size(current_a)), current_a, voltage_v, strict=True)))
    return path


def test_voltage_shows_the_direction_of_each_load_of_a_current_without_sign(tmp_path: Path) -> None:
    current_a, voltage_v = cycle(rest_s=60)
    capture = load_capture(save_cycle(tmp_path / "cell.csv", "Time,Current,Voltage", np.abs(current_a), voltage_v))
    np.testing.assert_array_equal(capture["current_a"], current_a)
    assert "signed (unsigned in the file; the voltage shows the direction of each load)" in capture.note


def test_current_without_sign_is_an_error_if_loads_of_both_directions_follow_each_other(tmp_path: Path) -> None:
    current_a, voltage_v = cycle(rest_s=0)
    path = save_cycle(tmp_path / "cell.csv", "Time,Current,Voltage", np.abs(current_a), voltage_v)
    with pytest.raises(
        UserError, match=r"cell\.csv: the current has no sign, and .*: export a signed current or a column of"
    ):
        load_capture(path)
    assert (load_capture(path, current_sign="discharge_positive")["current_a"] == 1.0).all()


def test_current_without_sign_in_a_table_of_this_project_is_a_warning(tmp_path: Path) -> None:
    current_a, voltage_v = cycle(rest_s=60)
    capture = load_capture(save_cycle(tmp_path / "a.csv", "time_s,current_a,voltage_v", np.abs(current_a), voltage_v))
    assert (capture["current_a"] >= 0.0).all()
    assert capture.warning.startswith("the current has no sign, although the voltage shows charge and discharge")


def test_discharge_with_recovery_at_a_small_current_is_one_direction(tmp_path: Path) -> None:
    current_a = np.tile(np.repeat([3.0, 0.2, 1.0, 0.0], 30), 5)
    recovery_v = np.tile(np.concatenate([np.zeros(30), np.linspace(0.0, 0.1, 30), np.zeros(60)]), 5)
    voltage_v = 4.0 - 1e-4 * np.cumsum(current_a) - 0.05 * current_a + recovery_v
    capture = load_capture(save_cycle(tmp_path / "cell.csv", "Time,Current,Voltage", current_a, voltage_v))
    np.testing.assert_array_equal(capture["current_a"], current_a)


def test_a_long_discharge_outweighs_two_steps_of_the_display(tmp_path: Path) -> None:
    current_a = np.concatenate([[0.0, 0.25, 0.25], np.full(297, 0.7)])
    voltage_v = np.concatenate([[3.0, 3.19, 3.19], 3.417 - 0.001 * np.arange(297)])
    for sign in (1.0, -1.0):
        path = save_cycle(tmp_path / "cell.csv", "Time,Current,Voltage", sign * current_a, voltage_v)
        np.testing.assert_array_equal(load_capture(path)["current_a"], current_a)


@pytest.mark.parametrize("words", ["0", "TABLE", "CC"])
def test_states_without_words_for_charge_or_discharge_are_no_sign(words: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.csv"
    rows = zip(M.time_s, M.charge_a, M.voltage_v, [words] * M.time_s.size, strict=True)
    path.write_text("Time,Current,Voltage,Mode\n" + text(rows))
    capture = load_capture(path)
    np.testing.assert_allclose(capture["current_a"], M.current_a)
    assert "positive on charge (response of the voltage)" in capture.note


def test_discharge_is_positive_if_nothing_shows_the_sign_and_the_note_says_so(tmp_path: Path) -> None:
    capture = load_capture(save(tmp_path / "cell.csv", "Time,Current,Voltage", M.charge_a, M.voltage_v * 0.0 + 3.7))
    np.testing.assert_allclose(capture["current_a"], M.charge_a)
    assert "positive on discharge (assumed: the file does not show it; --current-sign sets it)" in capture.note


def test_settings_define_the_sign_of_a_table_without_one(tmp_path: Path) -> None:
    path = save(tmp_path / "cell.csv", "Time,Current,Voltage", M.charge_a)
    (samples,) = open_capture(path, SensorSettings(current_sign="charge_positive"))
    np.testing.assert_allclose(samples["current_a"], M.current_a)


def test_settings_without_a_sensor_do_not_define_the_sign(tmp_path: Path) -> None:
    path = save(tmp_path / "cell.csv", "Time,Current,Voltage", M.charge_a)
    capture = open_capture(path, SensorSettings())
    (samples,) = capture
    np.testing.assert_allclose(samples["current_a"], M.current_a)
    assert "positive on charge (response of the voltage)" in capture.note


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


@pytest.mark.parametrize(
    ("discharge", "charge"),
    [("DISC", "CHRG"), ("Discharge", "Regen"), ("Step 2", "C-CV"), ("Décharge", "Charge"), ("恒流放电", "恒流充电")],
)
def test_loads_whose_state_has_no_word_have_the_direction_that_the_voltage_shows(
    discharge: str, charge: str, tmp_path: Path
) -> None:
    current_a, voltage_v = cycle(60)
    states = np.select([current_a > 0.0, current_a < 0.0], [discharge, charge], "Rest")
    path = tmp_path / "cell.csv"
    rows = zip(range(current_a.size), np.abs(current_a), voltage_v, states, strict=True)
    path.write_text("Time (s),Current (A),Voltage (V),Mode\n" + text(rows))
    np.testing.assert_array_equal(load_capture(path)["current_a"], current_a)


def test_words_for_one_direction_are_not_enough_if_the_voltage_shows_no_direction(tmp_path: Path) -> None:
    current_a, voltage_v = cycle(0)
    states = np.where(current_a > 0.0, "Discharge", "Regen")
    path = tmp_path / "cell.csv"
    rows = zip(range(current_a.size), np.abs(current_a), voltage_v, states, strict=True)
    path.write_text("Time (s),Current (A),Voltage (V),Mode\n" + text(rows))
    with pytest.raises(UserError, match="the current has no sign"):
        load_capture(path)


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_a_signed_current_keeps_its_sign_within_a_state(factor: float, tmp_path: Path) -> None:
    """A drive cycle with regenerative braking is one step for a cycler."""
    current_a, voltage_v = cycle(60)
    states = np.select([current_a > 0.0, current_a < 0.0], ["CC DChg", "CC Chg"], "Rest")
    braking = np.flatnonzero(current_a > 0.0)[::7]
    current_a[braking] = -0.5
    voltage_v[braking] += 0.075
    path = tmp_path / "cell.csv"
    rows = zip(range(current_a.size), factor * current_a, voltage_v, states, strict=True)
    path.write_text("Time (s),Current (A),Voltage (V),State\n" + text(rows))
    np.testing.assert_array_equal(load_capture(path)["current_a"], current_a)
