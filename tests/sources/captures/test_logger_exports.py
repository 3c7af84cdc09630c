"""Logs of vehicles and of Victron's portal are read as the same samples; batteries in one table are not mixed."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.sources.captures.tables.layout_finder import parse_column_map
from tests.sources.captures.cycler_exports import Export, Measurement, measure, stamps, text


def px4(m: Measurement) -> str:
    """Return the topic battery_status of a PX4 log, with a temperature of 0 because no probe is connected."""
    header = "timestamp,voltage_v,current_a,discharged_mah,remaining,temperature,cell_count,id\n"
    rows = zip(1e6 * m.time_s, m.voltage_v, m.current_a, m.zeros, m.ones, m.zeros, 4 * m.ones, m.ones, strict=True)
    return header + text(rows)


def ardupilot(m: Measurement, instances: tuple[int, ...] = (0,)) -> str:
    """Return the BAT messages of an ArduPilot log. The voltage of each further battery is 1 V higher."""
    header = "timestamp,TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res,RemPct\n"
    zeros = m.zeros
    tables = [
        zip(
            1.7e9 + m.time_s, 1e6 * m.time_s, instance * m.ones, m.voltage_v + instance, m.voltage_v, m.current_a,
            zeros, zeros, zeros, zeros, zeros, strict=True,
        )
        for instance in instances
    ]  # fmt: skip
    return header + text(row for rows in zip(*tables, strict=True) for row in rows)


def vesc(m: Measurement) -> str:
    """Return a log of VESC Tool. Each line ends with a separator."""
    header = "ms_today;input_voltage;temp_mos_max;temp_motor;current_motor;current_in;duty_cycle;amp_hours_used;\n"
    rows = zip(
        1e3 * m.time_s, m.voltage_v, m.zeros, m.zeros, 3.0 * m.current_a, m.current_a, m.zeros, m.zeros,
        [""] * m.step.size, strict=True,
    )  # fmt: skip
    return header + text(rows, ";")


def victron_vrm(m: Measurement, monitors: tuple[int, ...] = (279,)) -> str:
    """Return the CSV of the VRM portal: a row each with devices, names and units. The inverter has no values in most rows."""
    devices, names, units = ["timestamp", "VE.Bus System [276]"], ["Europe/Berlin (+01:00)", "Input power 1"], ["", "W"]
    for monitor in monitors:
        devices += 3 * [f"Battery Monitor [{monitor}]"]
        names += ["Voltage", "Current", "Battery temperature"]
        units += ["V", "A", "°C"]
    columns = [m.voltage_v, m.charge_a, m.temperature_c] * len(monitors)
    rows = zip(stamps(m, "%Y-%m-%d %H:%M:%S"), ["", "12"] * (m.step.size // 2), *columns, strict=True)
    return text([devices, names, units, *rows])


EXPORTS = (
    Export(px4, "PX4", has_temperature=False),
    Export(ardupilot, "ArduPilot", has_temperature=False),
    Export(vesc, "VESC Tool", has_temperature=False),
    Export(victron_vrm, "Victron VRM"),
)


@pytest.mark.parametrize("export", EXPORTS, ids=lambda export: export.dialect)
def test_log_is_read_without_options(export: Export, tmp_path: Path) -> None:
    capture, expected = load_capture(export.save(tmp_path)), measure()
    temperature_c = expected.temperature_c if export.has_temperature else np.full(expected.time_s.size, np.nan)
    np.testing.assert_allclose(capture["time_s"], expected.time_s, atol=1e-5)
    np.testing.assert_allclose(capture["current_a"], expected.current_a, atol=1e-9)
    np.testing.assert_allclose(capture["voltage_v"], expected.voltage_v, atol=1e-9)
    np.testing.assert_allclose(capture["temperature_c"], temperature_c, atol=1e-9)
    assert capture.note.startswith(f"read as {export.dialect} (")
    assert ("4 cells in series (calibrate, report: --series 4)" in capture.note) == (export.dialect == "PX4")
    assert capture.warning == ""


def save(folder: Path, content: str) -> Path:
    path = folder / "log.csv"
    path.write_text(content, encoding="utf-8")
    return path


def test_batteries_in_one_table_are_not_mixed(tmp_path: Path) -> None:
    path = save(tmp_path, ardupilot(measure(), (0, 1)))
    with pytest.raises(UserError, match=r"Inst = 0, 1: choose one by --map instance=0"):
        load_capture(path)
    for instance in (0, 1):
        capture = load_capture(path, column_map=parse_column_map(f"instance={instance}"))
        np.testing.assert_allclose(capture["voltage_v"], measure().voltage_v + instance)
    with pytest.raises(UserError, match=r"instance=2: no such battery; Inst = 0, 1"):
        load_capture(path, column_map={"instance": "2"})


@pytest.mark.parametrize("header", ["device", "Serial Number", "battery_id"])
def test_devices_with_names_in_one_table_are_not_mixed(header: str, tmp_path: Path) -> None:
    m = measure()
    rows = zip(m.time_s, m.charge_a, m.voltage_v, strict=True)
    both = "".join(f"{t:g},{name},{i},{v}\n" for t, i, v in rows for name in ("left", "right"))
    columns = f"time,{header},current,voltage\n"
    with pytest.raises(UserError, match=f"rows of several batteries, with different names in {header}: keep the rows"):
        load_capture(save(tmp_path, columns + both))
    one = "".join(line for line in both.splitlines(keepends=True) if "left" in line)
    np.testing.assert_array_equal(load_capture(save(tmp_path, columns + one))["voltage_v"], m.voltage_v)
    table = {"time": m.time_s, header: ["left"] * m.time_s.size, "current": m.charge_a, "voltage": m.voltage_v}
    np.testing.assert_array_equal(load_capture(table)["voltage_v"], m.voltage_v)


def test_instance_that_cannot_be_chosen_is_an_error(tmp_path: Path) -> None:
    path = save(tmp_path, vesc(measure()))
    with pytest.raises(
        UserError, match=r"log\.csv: --map instance=1: the table has no column with the number of the battery"
    ):
        load_capture(path, column_map={"instance": "1"})
    with pytest.raises(UserError, match=r"log\.csv: --map instance=left: must be a number"):
        load_capture(path, column_map={"instance": "left"})


def test_monitor_of_a_portal_with_several_is_chosen(tmp_path: Path) -> None:
    path = save(tmp_path, victron_vrm(measure(), (279, 512)))
    with pytest.raises(
        UserError, match=r"Battery Monitor \[279\] Current and Battery Monitor \[512\] Current: choose one"
    ):
        load_capture(path)
    given = "voltage=Battery Monitor [512] Voltage,current=Battery Monitor [512] Current"
    np.testing.assert_allclose(load_capture(path, column_map=parse_column_map(given))["voltage_v"], measure().voltage_v)


def test_gap_of_a_portal_has_no_value(tmp_path: Path) -> None:
    *lines, last = victron_vrm(measure()).splitlines()
    stamp = last.partition(",")[0]
    capture = load_capture(save(tmp_path, "\n".join([*lines, f"{stamp},,,,", last]) + "\n"))
    assert np.count_nonzero(np.isnan(capture["voltage_v"])) == 1
