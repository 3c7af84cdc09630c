"""Exports of cyclers, libraries and public data sets become the same samples, with a note of what was guessed."""

from pathlib import Path

import numpy as np
import pytest

from bms_estimator.model.columns import Columns
from bms_estimator.sources.captures.replay import load_capture
from tests.sources.captures.cycler_exports import EXPORTS, Export, compressed, measure, stamps, text


def assert_is_the_measurement(capture: Columns, *, has_temperature: bool) -> None:
    expected = measure()
    np.testing.assert_allclose(capture["time_s"], expected.time_s, atol=1e-6)
    np.testing.assert_allclose(capture["current_a"], expected.current_a, atol=1e-9)
    np.testing.assert_allclose(capture["voltage_v"], expected.voltage_v, atol=1e-9)
    temperature_c = expected.temperature_c if has_temperature else np.full(expected.time_s.size, np.nan)
    np.testing.assert_allclose(capture["temperature_c"], temperature_c, atol=1e-9)


@pytest.mark.parametrize("export", EXPORTS, ids=[export.write.__name__ for export in EXPORTS])
def test_export_is_read_without_options(export: Export, tmp_path: Path) -> None:
    capture = load_capture(export.save(tmp_path))
    assert_is_the_measurement(capture, has_temperature=export.has_temperature)
    assert capture.note.startswith(f"read as {export.dialect} (")
    assert capture.warning == ""


@pytest.mark.parametrize("suffix", [".gz", ".zip"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le"])
def test_compressed_text_in_any_encoding_is_read(suffix: str, encoding: str, tmp_path: Path) -> None:
    export = next(export for export in EXPORTS if export.write.__name__ == "german")
    plain = Export(export.write, export.dialect, encoding=encoding).save(tmp_path)
    assert_is_the_measurement(load_capture(compressed(plain, suffix)), has_temperature=True)


@pytest.mark.parametrize(
    "header",
    [
        "~Time[h]\tt-Step[h]\tU[V]\tI[A]",  # BaSyTec
        "Run Time (h)\tStep Time (h)\tPotential (V)\tCurrent (A)",  # Novonix
        "elapsed_time_h\tsoc\tpack_voltage_v\tpack_current_a",  # log of a BMS
    ],
)
def test_usual_names_of_other_programs_are_read(header: str, tmp_path: Path) -> None:
    m = measure()
    path = tmp_path / "cell.txt"
    path.write_text(f"{header}\n" + text(zip(m.time_s / 3600.0, m.step, m.voltage_v, m.charge_a, strict=True), "\t"))
    assert_is_the_measurement(load_capture(path), has_temperature=False)


@pytest.mark.parametrize(
    ("header", "time"),
    [
        ("Zeitstempel;Spannung [V];Strom [A]", "%d.%m.%Y %H:%M:%S"),
        ("Temps;Tension (V);Courant (A)", "%H:%M:%S"),
        ("Datum/Zeit;U [V];I [A]", "%d.%m.%y %H:%M:%S"),
        ("Tiempo;Voltaje (V);Corriente (A)", "%d-%b-%Y %H:%M:%S.000"),
        ("测试时间;电压/V;电流/A", "%H:%M:%S"),
        ("Device Time;Battery V;Current", "%d %B %Y %H:%M:%S"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "gbk"])
def test_names_and_dates_of_other_languages_are_read(header: str, time: str, encoding: str, tmp_path: Path) -> None:
    m = measure()
    rows = zip(stamps(m, time), m.voltage_v, m.current_a, strict=True)
    path = tmp_path / "log.csv"
    path.write_text(f"{header}\n" + text(rows, ";"), encoding=encoding)
    given = {"time": "Device Time", "voltage": "Battery V"} if "Device" in header else None
    capture = load_capture(path, column_map=given)
    np.testing.assert_allclose(capture["time_s"] - capture["time_s"][0], m.time_s, atol=1e-5)
    np.testing.assert_array_equal(capture["current_a"], m.current_a)
    np.testing.assert_array_equal(capture["voltage_v"], m.voltage_v)


def test_letters_of_latin_1_are_not_chinese(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "Prüfgerät Straße °C µA ±\nZeit;Spannung;Strom;Temperatur [°C]\n1;3,5;2;25\n2;3,4;2;25\n", "latin-1"
    )
    capture = load_capture(path)
    assert 'temperature "Temperatur [°C]" in °C' in capture.note


def test_columns_may_be_separated_by_spaces(tmp_path: Path) -> None:
    m = measure()
    rows = zip(m.time_s, m.voltage_v, m.current_a, strict=True)
    path = tmp_path / "log.txt"
    path.write_text(
        "~a text: words\n~Time[s]  U[V] I[A]\n" + "".join(f" {t:8.1f}  {v:.4f} {i:7.3f}\n" for t, v, i in rows)
    )
    np.testing.assert_array_equal(load_capture(path)["voltage_v"], m.voltage_v)
    path.write_text(path.read_text().replace(".", ","))
    np.testing.assert_array_equal(load_capture(path)["voltage_v"], m.voltage_v)


def test_columns_may_be_separated_by_bars(tmp_path: Path) -> None:
    m = measure()
    path = tmp_path / "log.txt"
    path.write_text("time | voltage | current\n" + text(zip(m.time_s, m.voltage_v, m.current_a, strict=True), " | "))
    np.testing.assert_array_equal(load_capture(path)["voltage_v"], m.voltage_v)


def test_a_potentiostat_names_the_reference_in_the_unit(tmp_path: Path) -> None:
    m = measure()
    rows = zip([""] * m.step.size, range(m.step.size), m.time_s, m.voltage_v, 1e3 * m.charge_a, strict=True)
    path = tmp_path / "cell.DTA"
    path.write_text("EXPLAIN\nCURVE\tTABLE\n\tPt\tT\tVf\tIm\n\t#\ts\tV vs. Ref.\tmA\n" + text(rows, "\t"))
    capture = load_capture(path)
    np.testing.assert_allclose(capture["current_a"], m.current_a)
