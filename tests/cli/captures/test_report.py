"""``report`` and the residuals of ``validate``: contents of the pages, a pack's history, and errors of the commands."""

import asyncio
import contextlib
import csv
import html
import io
import json
import math
import re

import numpy as np
import pytest

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.main import main
from bms_estimator.cli.options.pack_options import load_pack
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.pack_model.fit import fit
from bms_estimator.pack_model.history import History
from bms_estimator.pack_model.saved import history_arrays
from bms_estimator.sources.captures.replay import load_capture
from tests.calibration.simulated_load import TRUTH, capture, steps
from tests.command_line import error, run
from tests.pack_model.histories import Truth, cell_curves, measured_rows, with_voltages
from tests.store.test_history import record_history, snapshot_at

pytestmark = pytest.mark.usefixtures("empty_plots")  # but for the fixture ``page``, which is older than a test

PACK = '[pack]\nname = "shed"\ncell = "nmc"\ncapacity_ah = 30\nseries = 13\n'


def write_table(path, rows):
    np.savetxt(
        path,
        rows[["time_s", "current_a", "voltage_v", "temperature_c"]],
        delimiter=",",
        header="time_s,current_a,voltage_v,temperature_c",
        comments="",
        fmt="%.4f",
    )
    return path


def text_of(page):
    """Return the visible text of a page, with single spaces."""
    without_plots = re.sub(r"<svg.*?</svg>|<style>.*?</style>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", without_plots)).split())


@pytest.fixture(scope="module")
def steps_csv(tmp_path_factory):
    """Return a capture of the cell ``ncr18650`` with steps and rests at 25 °C, with a gap."""
    rows = capture(steps())
    rows["temperature_c"] = 25.0
    rows["time_s"][rows["time_s"] > 10_000.0] += 500.0
    return write_table(tmp_path_factory.mktemp("captures") / "steps.csv", rows)


@pytest.fixture(scope="module")
def page(tmp_path_factory, steps_csv):
    """Return the page of a report on ``steps_csv``."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as ended:
        main(["report", str(steps_csv), "--cell", "ncr18650", "--out", str(path)])
    assert not ended.value.code
    assert "The model predicts the voltage within" in out.getvalue()
    return path.read_text(encoding="utf-8")


def test_page_on_a_capture_has_verdict_figures_and_tables(page):
    text = text_of(page)
    assert re.search(r"The model predicts the voltage within [\d.]+ mV \(RMS per cell.*?: good\.", text)
    assert "The estimated SOC differs from coulomb counting by" in text
    assert (
        "Not known, because the captures do not show it: temperatures other than 25 °C; discharge above 1 C; charge."
        in text
    )
    figures = re.findall(r'aria-label="([^"]+)">\s*<svg', page)
    assert figures == [
        *("Voltage, measured and modeled", "Error of the modeled voltage", "SOC with ±2 std", "Current", "Temperature"),
        *("OCV", "Residuals of the OCV", "r_s", "r_ts", "r_tl", "c_ts", "c_tl", "RC product ts", "RC product tl"),
    ]
    assert re.search(r"SOC > 0\.1 [\d,]+ [\d.]+ [\d.]+ [\d.]+", text)
    assert re.search(r"R_s \[mΩ\] 50 % 86\.12 - [\d.]+ [\d.]+ agrees", text)
    assert "1 much longer than the sample period; the longest interval is 501 s" in text


def test_page_loads_nothing_and_ids_are_unique(page):
    assert "<script" not in page
    assert not re.search(r"@import|url\(\s*[\"']?(?!#)", page)
    assert not re.search(r"(?:src|href)\s*=\s*[\"'](?:https?:)?//", page.replace('xmlns:xlink="http', ""))
    sections = re.findall(r'id="(section-[^"]+)"', page)
    assert len(sections) == len(set(sections)) > 5


@pytest.mark.thorough
def test_several_captures_have_a_section_and_a_verdict_each(tmp_path, capsys, steps_csv):
    other = write_table(tmp_path / "other.csv", capture(steps(seed=3)))
    code, _, _ = run(capsys, "report", steps_csv, other, "--cell", "ncr18650", "--out", tmp_path / "report.html")
    assert code == 0
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "ncr18650: report on 2 captures" in text
    assert text.count("The model predicts the voltage within") == 3


async def test_page_on_a_history_has_days_events_and_gaps(tmp_path, capsys):
    (tmp_path / "pack.toml").write_text(PACK)
    minutes = [*range(600), *range(700, 1500)]
    await record_history(
        tmp_path / "shed.sqlite",
        [snapshot_at(60.0 * m, 3.0, 48.0, soc=0.9 - m / 2000, soc_std=0.01, temperature_c=21.0) for m in minutes],
    )
    arguments = ("--pack", tmp_path / "pack.toml", "--folder", tmp_path, "--out", tmp_path / "report.html")
    code, out, err = run(capsys, "report", *arguments)
    assert (code, err) == (0, "")
    assert "The pack's SOC at the end is 15.0 % ± 2.0 % (2 std)." in " ".join(out.split())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'aria-label="([^"]+)">\s*<svg', page) == ["SOC with ±2 std", "Voltage", "Current", "Temperature"]
    text = text_of(page)
    assert re.search(r"2023-11-15 .{5,12} 48\.00 … 48\.00 3\.0 … 3\.0 21 … 21", text)
    assert "1, the longest 100 minutes" in text
    assert "no checkpoint to read: none found" in text


@pytest.mark.parametrize(
    ("earlier_v", "warning"), [(13.3, "outside 15.60 to 32.00 V, the range of 8 cells in series"), (26.4, "")]
)
async def test_page_warns_of_the_history_of_an_earlier_pack_of_the_same_name(tmp_path, capsys, earlier_v, warning):
    (tmp_path / "pack.toml").write_text('[pack]\nname = "shed"\ncell = "lfp"\ncapacity_ah = 100\nseries = 8\n')
    rows = [snapshot_at(60.0 * minute, 2.0, earlier_v if minute < 3 else 26.5) for minute in range(8)]
    await record_history(tmp_path / "shed.sqlite", rows)
    arguments = ("--pack", tmp_path / "pack.toml", "--folder", tmp_path, "--out", tmp_path / "report.html")
    assert run(capsys, "report", *arguments)[0] == 0
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert warning in text
    assert (f"{tmp_path / 'shed.sqlite'} also has the history of an earlier pack" in text) == bool(warning)


def test_page_on_a_history_has_the_learned_parameters_of_the_checkpoint(tmp_path, capsys, steps_csv):
    (tmp_path / "pack.toml").write_text('[pack]\nname = "shed"\ncell = "ncr18650"\n')
    settings, model = load_pack(tmp_path / "pack.toml")
    estimator = compiled_estimator(settings, model)
    estimator.run(load_capture(steps_csv).rows)
    StateFiles(tmp_path, settings, model).checkpoint.save(estimator.record)
    asyncio.run(record_history(tmp_path / "shed.sqlite", [snapshot_at(0.0), snapshot_at(90.0)]))
    arguments = ("--pack", tmp_path / "pack.toml", "--folder", tmp_path, "--out", tmp_path / "report.html")
    code, _, err = run(capsys, "report", *arguments)
    assert (code, err) == (0, "")
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert float(re.search(r"capacity \[Ah\] ([\d.]+)", text)[1]) == pytest.approx(3.0, rel=0.05)
    assert float(re.search(r"R_s \[mΩ\] ([\d.]+)", text)[1]) > 86.0


def report_on_fitted_history(tmp_path, capsys, content):
    """Return the page on a pack with two minutes and the given file of history and fit."""
    (tmp_path / "pack.toml").write_text('[pack]\nname = "shed"\ncell = "nmc"\ncapacity_ah = 3\n')
    settings, model = load_pack(tmp_path / "pack.toml")
    file = StateFiles(tmp_path, settings, model).history
    file.save(content)
    asyncio.run(record_history(tmp_path / "shed.sqlite", [snapshot_at(0.0), snapshot_at(90.0)]))
    arguments = ("--pack", tmp_path / "pack.toml", "--folder", tmp_path, "--out", tmp_path / "report.html")
    code, _, err = run(capsys, "report", *arguments)
    assert (code, err) == (0, "")
    return file.path, (tmp_path / "report.html").read_text(encoding="utf-8")


def test_page_on_a_history_has_capacity_and_resistances_over_days(tmp_path, capsys):
    cell, truth = cell_curves("nmc"), Truth(ln_q=math.log(0.9))  # one of its days takes 9.5 h
    rows = with_voltages(cell, measured_rows(cell, days=20), truth)
    _, page = report_on_fitted_history(tmp_path, capsys, history_arrays(History(rows), fit(cell, rows)))
    figures = re.findall(r'aria-label="([^"]+)">\s*<svg', page)
    assert figures[-2:] == ["Capacity with ±2 std", "DC resistance with ±2 std"]
    found = re.search(r"capacity \[Ah\] ([\d.]+) ± ([\d.]+) ([+-][\d.]+) ± ([\d.]+) %", text_of(page))
    capacity_ah, std_ah, change, change_std = map(float, found.groups())
    assert capacity_ah == pytest.approx(2.7, abs=2.0 * std_ah)
    assert abs(change) < 2.0 * change_std
    assert re.search(r"DC resistance \[mΩ\] [\d.]+ ± [\d.]+ [+-][\d.]+ ± [\d.]+ %", text_of(page))


def test_page_on_a_short_history_has_capacity_and_resistances_of_now(tmp_path, capsys):
    cell = cell_curves("nmc")
    rows = with_voltages(cell, measured_rows(cell, days=1)[:40], Truth())
    _, page = report_on_fitted_history(tmp_path, capsys, history_arrays(History(rows), fit(cell, rows)))
    text = text_of(page)
    assert "Capacity with" not in page
    assert re.search(r"capacity \[Ah\] [\d.]+ ± [\d.]+ -", text)
    assert re.search(r"Slow fit to the last \d+\.\d hours of measurements", text)
    assert "A change per month needs at least 7 days of history." in text


def test_page_names_a_damaged_file_of_the_fit(tmp_path, capsys):
    path, page = report_on_fitted_history(tmp_path, capsys, {"rows": np.zeros(3)})
    assert f"{path} cannot be used: its rows have another layout." in text_of(page)


def test_user_errors_end_with_code_2(tmp_path, capsys, steps_csv):
    out = tmp_path / "report.html"
    (tmp_path / "pack.toml").write_text(PACK)
    damaged, old = tmp_path / "damaged", tmp_path / "old"
    damaged.mkdir()
    old.mkdir()
    (damaged / "shed.sqlite").write_bytes(b"\xff" * 600)
    asyncio.run(record_history(old / "shed.sqlite", [snapshot_at(0.0)]))
    for arguments, message in (
        ((), "give captures with --cell NAME|CELL.toml, or --pack pack.toml"),
        ((steps_csv,), "give either --cell"),
        ((steps_csv, "--cell", "pem_30w"), "is a fuel cell: report needs a battery"),
        ((steps_csv, steps_csv, "--cell", "ncr18650"), "given twice"),
        (("--pack", tmp_path / "pack.toml", "--folder", tmp_path), "no history there: the service has not run yet"),
        (("--pack", tmp_path / "pack.toml", "--folder", damaged), "file is not a database"),
        (("--pack", tmp_path / "pack.toml", "--folder", old, "--days", 1), "no rows in this period"),
        (("--pack", tmp_path / "house"), "house: cannot be read: No such file or directory"),
    ):
        code, printed, err = run(capsys, "report", *arguments, "--out", out)
        assert (code, printed) == (2, "")
        assert message in " ".join(err.split())
        assert not out.exists()
    out.write_text("mine")
    err = error(run(capsys, "report", steps_csv, "--cell", "ncr18650", "--out", out))
    assert "exists already; --force replaces it" in err
    assert out.read_text() == "mine"


@pytest.mark.parametrize("name", ["residuals.csv", "residuals.parquet"])
def test_residuals_are_measured_less_modeled_voltage(tmp_path, capsys, steps_csv, name):
    code, _, _ = run(capsys, "validate", steps_csv, "--cell", "ncr18650", "--out", tmp_path / name)
    assert code == 0
    samples, residuals = load_capture(steps_csv), load_capture(tmp_path / name)
    assert np.array_equal(residuals["time_s"], samples["time_s"])
    assert np.array_equal(residuals["voltage_v"], samples["voltage_v"])
    if name.endswith(".csv"):
        with (tmp_path / name).open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == ["time_s", "voltage_v", "modeled_v", "error_v", "soc", "current_a"]
        for row in rows[::500]:
            assert float(row["voltage_v"]) - float(row["modeled_v"]) == pytest.approx(float(row["error_v"]), abs=1e-12)
        assert float(rows[0]["soc"]) == pytest.approx(0.98, abs=2e-3)
    assert "exists already" in error(run(capsys, "validate", steps_csv, "--cell", "ncr18650", "--out", tmp_path / name))


def test_page_has_the_rated_capacity_of_the_cell(page):
    assert f"Cell model ncr18650, {TRUTH.cell.capacity_ah:g} Ah" in text_of(page)


def test_temperature_without_sensor_reaches_validation_and_report(tmp_path, capsys):
    rows = capture(steps(duration_s=4000))
    measured, unmeasured = rows.copy(), rows.copy()
    measured["temperature_c"], unmeasured["temperature_c"] = 0.0, np.nan
    paths = [write_table(tmp_path / "sensor.csv", measured), write_table(tmp_path / "no_sensor.csv", unmeasured)]
    cell, option = ("--cell", "nmc", "--capacity-ah", "3"), ("--temperature-c", "0")
    validated = []
    for path, options in zip((*paths, paths[1]), ((), option, ()), strict=True):
        _, out, _ = run(capsys, "validate", path, *cell, "--json", *options)
        validated.append(json.loads(out))
    _, out, _ = run(capsys, "report", paths[1], *cell, "--out", tmp_path / "page.html", *option)
    assert validated[0]["voltage_rms_mv"] == validated[1]["voltage_rms_mv"] != validated[2]["voltage_rms_mv"]
    assert validated[0]["verdict"] == " ".join(out.splitlines()[:-1])


def test_a_wrong_number_of_cells_is_an_error_of_the_report(tmp_path, capsys):
    rows = capture(steps())
    rows["voltage_v"] *= 2.0
    path, page = write_table(tmp_path / "two.csv", rows), tmp_path / "page.html"
    err = error(run(capsys, "report", path, "--cell", "ncr18650", "--out", page))
    assert "check the cell file and the number of cells in series (option --series of" in err
