"""``replay``: summary, table of estimates, and errors of unusable files."""

import csv
import gzip
import io
import json
import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from pyarrow import BufferOutputStream, parquet
from pyarrow.csv import read_csv

from bms_estimator.estimator.estimator import estimate
from bms_estimator.forecast.available_power import FORECAST
from bms_estimator.kernels.cell_model.chen_mora import delta
from bms_estimator.model.cell import load_cell
from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.telemetry.state import NOT_IDENTIFIED
from tests.command_line import error, run

pytestmark = pytest.mark.usefixtures("few_draws")

SUMMARY_KEYS = {  # some of the keys
    "samples",
    "duration_s",
    "soc_initial",
    "soc_final",
    "soc_std_final",
    "soc_rms_difference_to_coulomb",
    "innovation_rms_v",
    "tracking_error_rms_v",
    "lock_lost",
    "k_final",
    "samples_per_s",
    "wall_s",
}
COLUMNS = [  # some of the columns
    "time_s",
    "voltage_v",
    "current_a",
    "soc",
    "voltage_estimate_v",
    "innovation_v",
    "nussbaum_gain",
    "k",
    "soc_std",
    "r_s_ohm",
    "r_ts_ohm",
    "tau_ts_s",
    "r_tl_ohm",
    "tau_tl_s",
]
SAMPLES = 600
"""Number of samples of the capture, at 1 Hz."""


@pytest.fixture
def capture(tmp_path):
    """Write a capture of ten minutes with alternating rests and loads of 1 A."""
    path = tmp_path / "small.csv"
    rows = [(t, 0.0, 3.9) if t // 60 % 2 == 0 else (t, 1.0, 3.82) for t in range(SAMPLES)]
    lines = [f"{time},{current},{voltage}" for time, current, voltage in rows]
    path.write_text("\n".join(["time_s,current_a,voltage_v", *lines]) + "\n")
    return path


def columns_of_csv(path):
    """Return the columns of a table as arrays, by name."""
    data = path.read_bytes()
    text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
    header, *rows = csv.reader(text.splitlines())
    values = np.array([[float(cell) for cell in row] for row in rows])
    return dict(zip(header, values.T, strict=True))


def columns_of_parquet(path):
    """Return the columns of a table as arrays, by name."""
    table = parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def test_real_capture_gives_one_json_object_with_small_errors(data, capsys):
    capture = data / "leaf" / "hppc_25c_from_full.csv.gz"
    code, out, err = run(capsys, "replay", capture, "--cell", "leaf", "--json")
    assert (code, err) == (0, "")
    result = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} in the summary"))
    assert out.count("\n") == 1
    assert set(result) >= SUMMARY_KEYS
    assert result["lock_lost"] is False
    assert result["suspects"] == []
    with gzip.open(capture, "rt") as file:
        times = [float(line.split(",")[0]) for line in file if line[0].isdigit()]
    assert result["samples"] + sum(result["dropped"].values()) == len(times)
    assert result["duration_s"] == pytest.approx(times[-1] - times[0])
    assert result["soc_initial"] > 0.97
    assert result["soc_final"] < 0.05
    assert result["soc_rms_difference_to_coulomb"] < 0.005
    assert result["innovation_rms_v"] < 0.005
    assert result["tracking_error_rms_v"] < 0.01
    assert 0.0 < result["soc_std_final"] < 0.05


@pytest.mark.parametrize("name", ["out.csv", "out.csv.gz", "out.parquet"])
def test_estimates_sample_by_sample_agree_with_the_summary(name, capture, tmp_path, capsys):
    out = tmp_path / name
    code, text, err = run(capsys, "replay", capture, "--cell", "ncr18650", "--out", out, "--json")
    assert (code, err) == (0, "")
    columns = columns_of_parquet(out) if name.endswith(".parquet") else columns_of_csv(out)
    assert set(columns) >= set(COLUMNS)
    result = json.loads(text)
    assert {len(values) for values in columns.values()} == {result["samples"]} == {SAMPLES}
    assert np.array_equal(columns["time_s"], np.arange(SAMPLES))
    assert np.array_equal(np.unique(columns["current_a"]), [0.0, 1.0])
    assert columns["soc"][0] == result["soc_initial"]
    assert columns["soc"][-1] == result["soc_final"]
    assert columns["soc_std"][-1] == result["soc_std_final"]
    assert columns["k"][-1] == result["k_final"]
    for column, summary in (("innovation_v", "innovation_rms_v"), ("tracking_error_v", "tracking_error_rms_v")):
        assert math.sqrt(np.mean(columns[column] ** 2)) == pytest.approx(result[summary])
    assert columns["voltage_v"] - columns["voltage_estimate_v"] == pytest.approx(columns["innovation_v"], abs=1e-9)


@pytest.mark.parametrize("law", ["improved", "learning"])
def test_json_has_the_parameters_of_the_thesis_and_the_reason_why_the_last_row_has_no_margin(
    law, capture, tmp_path, capsys
):
    pack, out = tmp_path / "pack.toml", tmp_path / "out.csv"
    pack.write_text(
        f'[pack]\ncell = "chen_mora"\ncapacity_ah = 3\n[observer]\nlaw = "{law}"\n[identifier]\nsoc_std = 0.05\n'
    )
    code, text, _ = run(capsys, "replay", capture, "--pack", pack, "--out", out, "--json")
    assert code == 0
    columns, result = columns_of_csv(out), json.loads(text)
    assert list(result["parameters"]) == [f"a{i}" for i in range(1, 22)]
    a = {name: parameter["value"] for name, parameter in result["parameters"].items()}
    for name, values in (("delta_1", [a["a8"], a["a9"], a["a7"]]), ("delta_2", [a["a11"], a["a12"], a["a10"]])):
        assert result[name] == columns[name][-1]
        assert result[name] == pytest.approx(delta(*values), rel=1e-3)
    assert max(result["delta_1"], result["delta_2"]) > 0.0
    assert (result["stability_margin"], result["stability_margin_std"]) == (None, None)
    assert result["stability_margin_reason"] == NOT_IDENTIFIED
    assert np.isnan(columns["stability_margin"]).all()


@pytest.fixture
def discharge(tmp_path):
    """Write a capture of ten minutes with a constant load of 1 A."""
    path = tmp_path / "load.csv"
    rows = "".join(f"{time},1.0,{3.9 - 1e-4 * time}\n" for time in range(SAMPLES))
    path.write_text(f"time_s,current_a,voltage_v\n{rows}")
    return path


def test_the_table_and_the_summary_have_forecasts(discharge, tmp_path, capsys):
    out = tmp_path / "out.csv"
    code, text, err = run(capsys, "replay", discharge, "--cell", "ncr18650", "--out", out, "--json")
    assert (code, err) == (0, "")
    columns, result = columns_of_csv(out), json.loads(text)
    assert tuple(result["forecast"]) == FORECAST.names
    assert result["forecast_reason"] is None
    times_s = columns["time_to_cutoff_s"]
    assert np.isnan(times_s[:300]).all()  # too little load was seen
    assert times_s[-1] == pytest.approx(result["forecast"]["time_to_cutoff_s"], rel=0.2)
    assert (columns["time_to_cutoff_p05_s"] <= times_s)[-1]
    code, text, _ = run(capsys, "replay", discharge, "--cell", "ncr18650", "--json")
    assert code == 0
    assert json.loads(text)["forecast"] == result["forecast"]


def test_the_reason_for_a_missing_forecast_is_reported(tmp_path, capsys):
    capture = tmp_path / "short.csv"
    capture.write_text("time_s,current_a,voltage_v\n" + "".join(f"{time},1.0,3.8\n" for time in range(100)))
    code, out, _ = run(capsys, "replay", capture, "--cell", "ncr18650", "--json")
    assert code == 0
    result = json.loads(out)
    assert result["forecast"]["time_to_cutoff_s"] is None
    assert "of load have been seen" in result["forecast_reason"]
    assert "time to cut-off unknown: less than" in " ".join(
        run(capsys, "replay", capture, "--cell", "ncr18650")[1].split()
    )


def test_a_higher_cut_off_voltage_is_reached_earlier(discharge, capsys):
    times_s = []
    for cutoff_v in ("2.7", "3.5"):
        code, out, err = run(capsys, "replay", discharge, "--cell", "ncr18650", "--cutoff-v", cutoff_v, "--json")
        assert (code, err) == (0, "")
        times_s.append(json.loads(out)["forecast"]["time_to_cutoff_s"])
    assert times_s[1] < times_s[0]


def test_an_unusable_cut_off_voltage_is_reported(capture, capsys):
    err = error(run(capsys, "replay", capture, "--cell", "ncr18650", "--cutoff-v", "4.3"))
    assert "pack.cutoff_v = 4.3: must be below 4.16 V, the voltage of the full pack" in err
    assert "--cutoff-v: " in error(run(capsys, "replay", capture, "--cell", "pem_30w", "--cutoff-v", "8"))


def test_csv_and_parquet_are_equal_bit_for_bit(capture, tmp_path, capsys):
    for name in ("a.csv", "a.parquet"):
        assert run(capsys, "replay", capture, "--cell", "ncr18650", "--out", tmp_path / name)[0] == 0
    first, second = columns_of_csv(tmp_path / "a.csv"), columns_of_parquet(tmp_path / "a.parquet")
    assert list(first) == list(second)
    for name, values in first.items():
        assert np.array_equal(values, second[name], equal_nan=True), name


def test_replay_starts_at_the_given_soc(capture, capsys):
    initial_socs = []
    for soc in ("0.3", "0.7"):
        code, out, _ = run(capsys, "replay", capture, "--cell", "ncr18650", "--soc", soc, "--json")
        assert code == 0
        initial_socs.append(json.loads(out)["soc_initial"])
    assert initial_socs == pytest.approx([0.3, 0.7], abs=0.15)  # the first voltage corrects the SOC
    assert "'--soc'" in error(run(capsys, "replay", capture, "--cell", "ncr18650", "--soc", "1.5"))


def test_summary_is_printed_as_a_table(capture, capsys):
    code, out, _ = run(capsys, "replay", capture, "--cell", "ncr18650")
    assert code == 0
    assert "small.csv" in out
    assert f"{SAMPLES}" in out
    assert "mV" in out
    assert "kept" in out


def test_user_errors_end_with_code_2(capture, tmp_path, capsys):
    wrong = tmp_path / "wrong.csv"
    wrong.write_text(capture.read_text().replace("voltage_v", "reading"))
    no_number = tmp_path / "words.csv"
    no_number.write_text("time_s,current_a,voltage_v\n0,0,3.9\n1,none,3.9\n")
    missing, other = tmp_path / "missing.csv", tmp_path / "other.csv"
    other.write_text("kept as it is\n")
    cell = ("--cell", "ncr18650")
    for arguments, message_parts in [
        ((missing, *cell), ["missing.csv: no such file"]),
        ((missing, *cell, "--out", other, "--force"), ["missing.csv: no such file"]),
        ((capture, *cell, "--out", other), ["other.csv: exists already; --force replaces it"]),
        ((capture, "--cell", "nonsense"), ["nonsense", "ncr18650"]),
        ((capture, "--cell", ""), ["(empty name)", "ncr18650"]),
        ((wrong, *cell), ["wrong.csv", "voltage_v"]),
        ((no_number, *cell), ["words.csv", "line 3", "current_a", "none"]),
        ((capture,), ["--cell", "--pack"]),
        ((capture, "--cell", "nmc"), ["nmc is a generic cell", "--capacity-ah"]),
        ((capture, *cell, "--capacity-ah", "-3"), ["capacity_ah = -3.0", "above 0"]),
        ((capture, *cell, "--capacity-ah", "nan"), ["--capacity-ah", "no decimal number"]),
        ((capture, *cell, "--out", tmp_path / "out.xlsx"), ["out.xlsx", ".csv", ".parquet"]),
        ((capture, *cell, "--out", tmp_path / "no" / "out.csv"), ["out.csv", "there is no folder"]),
        ((capture, *cell, "--mqtt", "nonsense"), ["--mqtt", "nonsense"]),
    ]:
        code, out, err = run(capsys, "replay", *arguments)
        assert (code, out) == (2, ""), arguments
        assert [part for part in message_parts if part not in err] == [], err
        assert "Traceback" not in err
    assert other.read_text() == "kept as it is\n"


@pytest.mark.parametrize("capacity_from", ["option", "pack", "option over pack"])
def test_generic_cell_has_the_given_capacity(capacity_from, capture, tmp_path, capsys):
    pack, out = tmp_path / "pack.toml", tmp_path / "out.csv"
    in_pack_file = {"pack": "capacity_ah = 3\n", "option over pack": "capacity_ah = 50\n"}.get(capacity_from, "")
    pack.write_text(f'[pack]\ncell = "nmc"\n{in_pack_file}')
    option = () if capacity_from == "pack" else ("--capacity-ah", "3")
    assert run(capsys, "replay", capture, "--pack", pack, "--soc", "0.6", *option, "--out", out)[0] == 0
    first_soc, last_soc = columns_of_csv(out)["soc_coulomb"][[0, -1]]
    assert 3.0 * (first_soc - last_soc) == pytest.approx(SAMPLES / 2 / 3600, rel=0.02)  # 1 A for half of the time


def test_capture_is_never_overwritten(capture, tmp_path, capsys):
    before, link = capture.read_bytes(), tmp_path / "link.csv"
    link.symlink_to(capture)
    for out in (capture, link):
        err = error(run(capsys, "replay", capture, "--cell", "ncr18650", "--out", out, "--force"))
        assert "is also an input" in err
    assert capture.read_bytes() == before


def test_truncated_gzip_is_reported(capture, tmp_path, capsys):
    complete, truncated = tmp_path / "complete.csv.gz", tmp_path / "truncated.csv.gz"
    with gzip.open(complete, "wb") as packed, capture.open("rb") as plain:
        shutil.copyfileobj(plain, packed)
    truncated.write_bytes(complete.read_bytes()[:-20])
    assert run(capsys, "replay", complete, "--cell", "ncr18650", "--json")[0] == 0
    err = error(run(capsys, "replay", truncated, "--cell", "ncr18650", "--json"))
    assert "truncated.csv.gz: gzip data damaged or cut short" in err


def test_unreadable_capture_does_not_replace_old_estimates(capture, tmp_path, capsys):
    out, wrong = tmp_path / "out.csv", tmp_path / "wrong.csv"
    assert run(capsys, "replay", capture, "--cell", "ncr18650", "--out", out)[0] == 0
    before = out.read_bytes()
    wrong.write_text("time_s,voltage_v\n0,3.7\n")
    assert run(capsys, "replay", wrong, "--cell", "ncr18650", "--out", out, "--force")[0] == 2
    assert out.read_bytes() == before


def test_a_capture_without_a_usable_sample_is_an_error(tmp_path, capsys):
    empty = tmp_path / "nan.csv"
    empty.write_text("time_s,current_a,voltage_v\n0,0.1,nan\n1,0.1,9.9\n")
    code, out, err = run(capsys, "replay", empty, "--cell", "ncr18650", "--json")
    assert (code, out) == (2, "")
    assert "nan.csv: no usable sample; dropped: 1 not finite, 1 outside the cell's range" in err
    assert err.endswith("are there 3 to 4 times as many cells in series (pack.series)?\n")


def test_error_suggests_the_unit_of_the_columns(capture, tmp_path, capsys):
    """The voltage is in millivolts, or the current in milliamperes, which is seen only in the rows with a load."""
    rows = read_csv(capture).to_pylist()
    head = ",".join(rows[0])
    tables = {
        "volt.csv": ("voltage_v", "are these millivolts?"),
        "ampere.csv": ("current_a", "are these milliamperes?"),
    }
    for name, (column, guess) in tables.items():
        lines = [",".join(str(1e3 * value if key == column else value) for key, value in row.items()) for row in rows]
        (tmp_path / name).write_text("\n".join([head, *lines]))
        _, out, err = run(capsys, "replay", tmp_path / name, "--cell", "chen_mora")
        assert guess in " ".join((out + err).split())


def test_missing_and_implausible_temperatures_are_reported(tmp_path, capsys):
    for temperature_c, message in (
        (297.0, "10 implausible values: SOC std is larger"),
        (math.nan, "not measured: SOC std is larger"),
    ):
        table = tmp_path / "warm.csv"
        lines = [f"{j},0.1,3.8,{temperature_c}" for j in range(10)]
        table.write_text("\n".join(["time_s,current_a,voltage_v,temperature_c", *lines]))
        _, out, _ = run(capsys, "replay", table, "--cell", "ncr18650")
        assert message in " ".join(out.split())


def test_backward_time_steps_are_reported(tmp_path, capsys):
    backwards = tmp_path / "backwards.csv"
    backwards.write_text("time_s,current_a,voltage_v\n" + "".join(f"{9 - j},0.1,3.8\n" for j in range(10)))
    code, out, _ = run(capsys, "replay", backwards, "--cell", "ncr18650")
    assert code == 0
    assert re.search(r"clock set back +9 times: are the rows in the order of time\?", out)
    assert re.search(r"duration +0.0 s", out)


def test_folder_is_rejected_as_capture(tmp_path, capsys):
    assert f"{tmp_path}: is a directory" in error(run(capsys, "replay", tmp_path, "--cell", "ncr18650"))


def test_replay_equals_estimate_bit_for_bit(data, tmp_path, capsys):
    capture, out = tmp_path / "begin.csv", tmp_path / "out.csv"
    lines = gzip.decompress((data / "leaf" / "cc_1c.csv.gz").read_bytes()).decode().splitlines()[:400]
    capture.write_text("\n".join(lines) + "\n")
    assert run(capsys, "replay", capture, "--cell", "leaf", "--soc", 0.2, "--no-pack-model", "--out", out)[0] == 0
    trace = estimate(load_capture(capture), load_cell("leaf"), initial_soc=0.2)
    columns = columns_of_csv(out)
    for name in trace.names:
        assert np.array_equal(columns[name], trace[name], equal_nan=True), name


def as_raw(path):
    """Return the bytes of a recording of a board that prints the samples of a CSV file as text lines."""
    recorded = path.with_name("small.bms")
    with CaptureWriter(recorded, CaptureHeader(mode="text")) as writer:
        for line in path.read_text().splitlines()[1:]:
            time_s, current_a, voltage_v = line.split(",")
            writer.write(float(time_s), f"{voltage_v},{current_a}\n".encode())
    return recorded.read_bytes()


def test_documented_replays_run(monkeypatch, capsys):
    root = Path(__file__).parents[3]
    text = (root / "docs/cell/validate.md").read_text()
    commands = re.findall(r"bms-estimator (replay tests/data/.+)", text)
    assert commands
    monkeypatch.chdir(root)
    for command in commands:
        assert run(capsys, *command.split())[0] == 0, command


def as_parquet(path):
    """Return the bytes of a Parquet file with the samples of a CSV file."""
    buffer = BufferOutputStream()
    parquet.write_table(read_csv(path), buffer)
    return buffer.getvalue().to_pybytes()


def replay_stdin(monkeypatch, capsys, data, *arguments):
    """Replay these bytes from stdin. Return exit code, stdout and stderr."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))
    return run(capsys, "replay", "-", "--cell", "ncr18650", *arguments)


@pytest.mark.parametrize(
    "convert",
    [
        Path.read_bytes,
        lambda path: gzip.compress(path.read_bytes()),
        as_parquet,
        as_raw,
        lambda path: gzip.compress(as_raw(path)),
    ],
    ids=["CSV", "CSV.gz", "Parquet", "raw", "raw.gz"],
)
def test_capture_of_every_format_is_read_from_stdin(convert, capture, monkeypatch, capsys):
    code, out, err = replay_stdin(monkeypatch, capsys, convert(capture), "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["samples"] == SAMPLES


def test_closed_stdin_is_reported(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", None)
    assert run(capsys, "replay", "-", "--cell", "ncr18650") == (
        2,
        "",
        "error: stdin: closed; nothing can be read from it\n",
    )


def test_error_on_stdin_shows_no_path(monkeypatch, capsys):
    for data, message in [
        (b"time_s,current_a,voltage_v\n0,none,3.7\n", "stdin: line 2: current_a = 'none': must be a number"),
        (b"", "stdin: is empty\n"),
        (b"\n", "stdin: not a capture: no line names the columns; needed: time_s,current_a,voltage_v"),
        (b"\x1f\x8b\x08 no gzip", "stdin: gzip data damaged or cut short"),
    ]:
        code, out, err = replay_stdin(monkeypatch, capsys, data)
        assert (code, out) == (2, "")
        assert err.startswith(f"error: {message}")


def replayed_currents(capsys, out, *arguments):
    """Replay with these arguments. Return the distinct currents in the estimator [A], and True if a warning is printed."""
    code, _, err = run(capsys, "replay", *arguments, "--out", out, "--force")
    assert code == 0
    is_warned = "but the voltage shows that it is positive on" in err
    assert is_warned or "warning" not in err
    return np.unique(columns_of_csv(out)["current_a"]).tolist(), is_warned


def test_sign_of_a_table_is_that_of_the_option_or_else_of_the_pack(capture, tmp_path, capsys):
    out, pack = tmp_path / "out.csv", tmp_path / "pack.toml"
    pack.write_text('[sensor]\ncurrent_sign = "charge_positive"\n')
    charge, discharge = (("--current-sign", f"{sign}_positive") for sign in ("charge", "discharge"))
    assert replayed_currents(capsys, out, capture, "--cell", "ncr18650") == ([0.0, 1.0], False)
    assert replayed_currents(capsys, out, capture, "--cell", "ncr18650", *charge) == ([-1.0, 0.0], False)
    assert replayed_currents(capsys, out, capture, "--pack", pack) == ([-1.0, 0.0], True)
    assert replayed_currents(capsys, out, capture, "--pack", pack, *discharge) == ([0.0, 1.0], False)


def test_battery_data_format_is_charge_positive_unless_the_option_says_otherwise(capture, tmp_path, capsys):
    bdf, out, pack = tmp_path / "small.bdf", tmp_path / "out.csv", tmp_path / "pack.toml"
    bdf.write_text(capture.read_text().replace("time_s,current_a,voltage_v", "Test Time / s,Current / A,Voltage / V"))
    for sign in ("charge_positive", "discharge_positive"):
        pack.write_text(f'[sensor]\ncurrent_sign = "{sign}"\n')
        assert replayed_currents(capsys, out, bdf, "--pack", pack) == ([-1.0, 0.0], True)
    currents = replayed_currents(capsys, out, bdf, "--pack", pack, "--current-sign", "discharge_positive")
    assert currents == ([0.0, 1.0], False)


def test_recording_of_another_protocol_is_rejected(tmp_path, capsys):
    capture, pack = tmp_path / "meter.bmsraw", tmp_path / "pack.toml"
    with CaptureWriter(capture, CaptureHeader("junctek", "/dev/ttyUSB0", 115_200, "charge_positive")) as writer:
        writer.write(0.0, b":r50=1,34,5166,1030,109337,11738441,62100651,48663,125,0,99,0,644,9117,\r\n")
    pack.write_text("[pack]\n")
    err = error(run(capsys, "replay", capture, "--pack", pack))
    assert "recorded with protocol 'junctek', but sensor.protocol is 'binary'" in err
