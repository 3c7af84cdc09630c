"""Time base of a table: Unix times, units that a second time column shows, the better of two columns, order of the date."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.columns import Columns
from bms_estimator.sources.captures.replay import load_capture
from tests.sources.captures.cycler_exports import text

START = datetime(2026, 3, 4, 9, 0, 0, tzinfo=UTC)
SECONDS = np.arange(60)
CURRENT_A = np.where(SECONDS % 20 < 10, 0.0, 2.0)
VOLTAGE_V = np.round(3.9 - 0.001 * np.cumsum(CURRENT_A) - 0.05 * CURRENT_A, 4)


def load(path: Path, columns: dict[str, object], rows: slice = slice(None)) -> Columns:
    """Return the capture of a table with these times, a current and a voltage."""
    values = columns | {"Current (A)": CURRENT_A[rows], "Voltage (V)": VOLTAGE_V[rows]}
    path.write_text(",".join(values) + "\n" + text(zip(*values.values(), strict=True)))
    return load_capture(path)


def stamps(seconds: object, time_format: str = "%m/%d/%Y %I:%M:%S %p") -> list[str]:
    """Return date and time of each second."""
    return [(START + timedelta(seconds=float(second))).strftime(time_format) for second in np.asarray(seconds)]


@pytest.mark.parametrize(("unit", "units_per_s"), [("ms", 10**3), ("µs", 10**6), ("ns", 10**9)])
@pytest.mark.parametrize("name", ["timestamp", "time"])
def test_large_numbers_are_unix_times(name: str, unit: str, units_per_s: int, tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {name: [(1_700_000_000 + int(s)) * units_per_s for s in SECONDS]})
    np.testing.assert_allclose(capture["time_s"] - 1.7e9, SECONDS, atol=1e-6)
    assert f'time "{name}" in {unit} (Unix time)' in capture.note


@pytest.mark.parametrize(("unit", "unit_s"), [("s", 1.0), ("min", 60.0), ("h", 3600.0), ("ms", 1e-3)])
@pytest.mark.parametrize("pause_s", [0.0, 3600.0])
def test_a_second_time_column_shows_the_unit_of_the_first(
    unit: str, unit_s: float, pause_s: float, tmp_path: Path
) -> None:
    elapsed_s = 30.0 * SECONDS
    clock_s = elapsed_s + pause_s * (SECONDS > 50)  # the test was paused, and its time with it
    capture = load(tmp_path / "log.csv", {"Test Time": elapsed_s / unit_s, "DPT Time": stamps(clock_s)})
    np.testing.assert_allclose(capture["time_s"], elapsed_s, atol=1e-6)
    assert f'time "Test Time" in {unit} (by "DPT Time")' in capture.note
    assert capture.warning == ""


def test_disagreement_of_two_time_columns_is_a_warning_with_a_remedy(tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {"Test Time [s]": 0.5 * SECONDS, "DPT Time": stamps(30.0 * SECONDS)})
    assert '"Test Time [s]" in s disagrees with "DPT Time", which advances by 60 s' in capture.warning
    assert '--map "time=DPT Time"' in capture.warning


def test_an_unreadable_second_time_column_is_ignored(tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {"Test Time": SECONDS, "DPT Time": ["soon", *["?"] * 59]})
    np.testing.assert_array_equal(capture["time_s"], SECONDS)


def test_the_finer_of_two_time_columns_is_used(tmp_path: Path) -> None:
    fine = [f"00:00:{0.1 * i:06.3f}" for i in SECONDS]
    capture = load(tmp_path / "log.csv", {"Time Stamp": stamps(SECONDS // 10), "Prog Time": fine})
    np.testing.assert_allclose(capture["time_s"], 0.1 * SECONDS, atol=1e-9)
    assert 'time "Prog Time" as duration ("Time Stamp" repeats times, or goes back)' in capture.note


def test_a_clock_replaces_a_test_time_that_restarts(tmp_path: Path) -> None:
    clock_s = np.where(SECONDS < 30, 60.0 * SECONDS, 60.0 * SECONDS + 360.0)
    capture = load(tmp_path / "log.csv", {"Run Time (h)": (SECONDS % 30) / 60.0, "Date Time": stamps(clock_s)})
    np.testing.assert_allclose(capture["time_s"], clock_s)


@pytest.mark.parametrize("time_format", ["%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%d-%m-%y %H:%M:%S"])
@pytest.mark.parametrize("first_row", [0, 30])
def test_day_and_month_have_one_order_in_a_file(time_format: str, first_row: int, tmp_path: Path) -> None:
    elapsed_s = 43_200.0 * SECONDS[first_row:]  # from the 4th, or from the 19th
    capture = load(tmp_path / "log.csv", {"Timestamp": stamps(elapsed_s, time_format)}, slice(first_row, None))
    np.testing.assert_allclose(capture["time_s"], elapsed_s - elapsed_s[0])


def test_the_order_follows_from_dates_after_many_rows(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    elapsed_s = 3600.0 * np.arange(400)  # the 13th begins after row 200
    rows = zip(stamps(elapsed_s, "%d/%m/%Y %H:%M"), [1.0] * 400, 4.0 - 1e-3 * np.arange(400), strict=True)
    path.write_text("Timestamp,Current,Voltage\n" + text(rows))
    np.testing.assert_allclose(load_capture(path)["time_s"], elapsed_s)


@pytest.mark.parametrize(("step", "remedy"), [(1e5, "[ms]"), (500, "[ms]"), (1 / 3600, "[h]")])
def test_an_implausible_sample_period_is_a_warning_with_a_remedy(step: float, remedy: str, tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {"Time": step * SECONDS})
    assert f'state the unit, as in --map "time=Time {remedy}"' in capture.warning


def test_px4_writes_microseconds_since_boot(tmp_path: Path) -> None:
    header = "timestamp,voltage_v,current_a,cell_count"
    path = tmp_path / "battery_status_0.csv"
    path.write_text(header + "\n" + text((123_456_789 + 100_000 * int(s), 14.6, 8.0, 4) for s in SECONDS))
    capture = load_capture(path)
    np.testing.assert_allclose(capture["time_s"], 123.456789 + 0.1 * SECONDS)
    assert (capture["current_a"] == 8.0).all()


@pytest.mark.parametrize("date_format", ["%Y-%m-%d", "%d/%m/%Y", "%d.%m.%Y"])
def test_times_of_the_day_follow_the_date_in_another_column(date_format: str, tmp_path: Path) -> None:
    elapsed_s = 3600.0 * SECONDS
    columns = {"Date": stamps(elapsed_s, date_format), "Time": stamps(elapsed_s, "%H:%M:%S")}
    capture = load(tmp_path / "log.csv", columns)
    np.testing.assert_array_equal(capture["time_s"], elapsed_s)
    assert 'time "Time" as duration (after "Date")' in capture.note


def test_a_time_since_the_start_does_not_follow_the_date(tmp_path: Path) -> None:
    elapsed_s = 600.0 * SECONDS
    columns = {
        "Date": stamps(elapsed_s + 50_000.0, "%Y-%m-%d"),
        "Test Time": [f"{int(s) // 3600:02d}:{int(s) // 60 % 60:02d}:00" for s in elapsed_s],
    }
    np.testing.assert_array_equal(load(tmp_path / "log.csv", columns)["time_s"], elapsed_s)


def test_seconds_beyond_the_year_2096_are_a_warning_with_a_remedy(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = zip(1_700_000_000_000 + 1000 * SECONDS, CURRENT_A, VOLTAGE_V, strict=True)
    path.write_text("time_s,current_a,voltage_v\n" + text(rows))
    assert 'if it is Unix time, use --map "time=time_s [ms]"' in load_capture(path).warning
    mapped = load_capture(path, column_map={"time": "time_s [ms]"})
    np.testing.assert_array_equal(mapped["time_s"], 1.7e9 + SECONDS)


@pytest.mark.parametrize("time_format", ["%H:%M:%S", "%d.%m.%Y %H:%M:%S"])
def test_a_clock_goes_on_across_midnight_and_the_end_of_summer_time(time_format: str, tmp_path: Path) -> None:
    half = SECONDS >= 30
    shift_s = np.where(half, -3600.0, 0.0) if "Y" in time_format else np.full(60, 15 * 3600.0 - 30.0)
    capture = load(tmp_path / "log.csv", {"Time": stamps(SECONDS + shift_s, time_format)})
    np.testing.assert_allclose(capture["time_s"] - capture["time_s"][0], SECONDS)


@pytest.mark.parametrize("back_s", [1200.0, 4000.0, 7200.0])
def test_a_clock_that_was_set_back_otherwise_is_not_changed(back_s: float, tmp_path: Path) -> None:
    times = stamps(SECONDS - back_s * (SECONDS >= 30), "%d.%m.%Y %H:%M:%S")
    capture = load(tmp_path / "log.csv", {"Time": times})
    assert (np.diff(capture["time_s"]) < 0.0).sum() == 1


def test_a_duration_that_restarts_is_not_midnight(tmp_path: Path) -> None:
    times = [f"{hour}:00:{second:02d}" for hour in (26, 2) for second in range(30)]
    capture = load(tmp_path / "log.csv", {"Time": times})
    assert (np.diff(capture["time_s"]) < 0.0).sum() == 1


@pytest.mark.parametrize("times", [stamps(SECONDS), [f"0:00:{second:02d}" for second in SECONDS], SECONDS.tolist()])
def test_rows_with_the_newest_first_are_reversed(times: list[object], tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = list(zip(times, CURRENT_A, VOLTAGE_V, strict=True))
    path.write_text("Time,Current (A),Voltage (V)\n" + text(rows[::-1]))
    capture = load_capture(path)
    np.testing.assert_allclose(capture["time_s"], SECONDS)
    np.testing.assert_array_equal(capture["current_a"], CURRENT_A)
    assert "the newest row is the first" in capture.note


def test_numbers_of_days_are_dates_of_a_spreadsheet(tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {"Date": [f"{45_356.999 + s / 86_400:.9f}" for s in SECONDS]})
    np.testing.assert_allclose(np.diff(capture["time_s"]), 1.0, atol=1e-3)
    assert 'time "Date" in d (days of a spreadsheet)' in capture.note


@pytest.mark.parametrize("begin", [0, 1])
@pytest.mark.parametrize("as_text", [str, lambda second: f"0:00:{second:02d}"])
def test_a_time_that_starts_again_with_each_step_is_joined(
    begin: int, as_text: Callable[[int], str], tmp_path: Path
) -> None:
    capture = load(tmp_path / "log.csv", {"Time": [as_text(int(second) % 10 + begin) for second in SECONDS]})
    assert (np.diff(capture["time_s"]) > 0.0).all()
    assert capture["time_s"][-1] - capture["time_s"][0] == pytest.approx(59.0 if begin else 54.0, abs=1e-4)
    assert "starts again with each step: the steps are joined" in capture.note


def test_a_time_that_starts_again_within_steps_is_not_joined(tmp_path: Path) -> None:
    capture = load(tmp_path / "log.csv", {"Time": (SECONDS + 5) % 20})
    assert (np.diff(capture["time_s"]) < 0.0).sum() == 3
