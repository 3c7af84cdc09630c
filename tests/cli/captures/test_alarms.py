"""``alarms``: raised alarms of a capture. ``config``: check and output of the alarms' limits and hooks."""

import csv
import gzip
import json
from pathlib import Path

import pytest

from bms_estimator.sources.captures.raw_capture import CaptureHeader, CaptureWriter
from tests.command_line import error, run
from tests.telemetry.alarm_captures import Line, record

LEAF = Path(__file__).parents[2] / "data" / "leaf" / "cc_1c.csv.gz"
LEAF_CHARGED_S = 17_000.0
"""Time at which the part of the capture ends [s]."""


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    """Write a pack file that ends with the headline of ``[alarms]``, to which tests append."""
    file = tmp_path / "pack.toml"
    file.write_text("[pack]\ncell = 'nmc'\ncapacity_ah = 10\nseries = 2\n[sensor]\nprotocol = 'text'\n[alarms]\n")
    return file


def test_raised_alarms_are_listed_with_their_times(
    tmp_path: Path, pack: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        Line(seconds=30),
        Line(seconds=10, voltage_v=8.6),
        Line(seconds=30),
        Line(seconds=20, temperature_c=60.0),
        Line(seconds=80, temperature_c=54.9),
    ]
    capture = record(tmp_path / "capture.bms", lines)
    with pack.open("a") as file:
        file.write("over_temperature = {delay_s = 5}\nhook = [{run = ['/none/such']}]\n")
    code, out, _ = run(capsys, "alarms", capture, "--pack", pack, "--json")
    assert code == 0
    result = json.loads(out)
    times = {each["alarm"]: (each["raised_s"], each["ended_s"], each["latched"]) for each in result["raised"]}
    assert times == {
        "pack_over_voltage": (pytest.approx(32.0), None, True),  # 30 s and its delay_s of 2 s
        # 70 s and its delay_s of 5 s; 90 s and its clear_delay_s of 60 s
        "over_temperature": (pytest.approx(75.0), pytest.approx(150.0), False),
    }
    unmeasured = ["cell_over_voltage", "cell_under_voltage", "soc_low", "collapse_risk", "stability_margin_low"]
    unmeasured += ["cell_imbalance", "weak_cell"]
    assert result["unmeasured"] == unmeasured
    assert "discharge_over_current" in result["quiet"]
    code, out, _ = run(capsys, "alarms", capture, "--pack", pack)
    assert code == 0
    assert "over_temperature" in out
    assert "latched" in out


def test_collapse_risk_is_raised_before_the_cut_off_of_a_real_cell_and_cleared_in_its_charge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The capture is of a Leaf cell: a discharge at 1 C to 3.0 V, a rest of half an hour, and a charge at C/2."""
    capture, pack_file = tmp_path / "leaf.csv", tmp_path / "pack.toml"
    with gzip.open(LEAF, "rt") as file:
        rows = [row for row in csv.reader(file) if row[0] == "time_s" or 9500.0 < float(row[0]) < LEAF_CHARGED_S]
    with capture.open("w") as file:
        csv.writer(file).writerows(rows)
    pack_file.write_text("[pack]\ncell = 'leaf'\ncutoff_v = 3.05\n")
    cutoff_s = next(float(row[0]) for row in rows[1:] if float(row[2]) < 3.05)
    code, out, _ = run(capsys, "alarms", capture, "--pack", pack_file, "--json")
    assert code == 0
    (alarm,) = (each for each in json.loads(out)["raised"] if each["alarm"] == "collapse_risk")
    assert cutoff_s - 600.0 < alarm["raised_s"] < cutoff_s - 60.0
    assert cutoff_s < alarm["ended_s"]
    assert alarm["value"] >= alarm["limit"]


@pytest.mark.parametrize(
    ("alarms", "code", "message"),
    [
        ("soc_low = {limit = 0.2, clear = 0.1}", 2, "alarms.soc_low.clear = 0.1: must not be below limit = 0.2"),
        ("pack_over_voltage = {limit_v = 4.2}", 0, "alarms.pack_over_voltage.limit_v = 4.2: outside 7.3 to 9 V"),
        ("pack_over_voltage = {limit_v = 8.4, clear_v = 8.4}", 0, ""),
        ("pack_over_voltage = {limit_c = 4.2}", 2, "alarms.pack_over_voltage.limit_c: unknown key"),
        ("over_voltage = {limit_v = 4.2}", 2, "alarms.over_voltage: unknown key"),
        ("hook = [{run = ['/none/such']}]", 0, "alarms.hook.0.run = /none/such: no such program here"),
        ("hook = [{relay = 'high'}]", 2, "alarms.hook.0.relay: only the board of [sensor] with protocol = 'binary'"),
        ("hook = [{topic = 'load/set'}]", 2, "alarms.hook.0.topic = load/set: there is no broker"),
        ("hook = [{}]", 2, "give exactly one of run, topic and relay"),
        ("hook = [{topic = 'a', payload = '$nothing'}]", 2, "payload: 'nothing': must be one of $json"),
    ],
)
def test_check_reports_wrong_and_implausible_limits_and_hooks(
    pack: Path, capsys: pytest.CaptureFixture[str], alarms: str, code: int, message: str
) -> None:
    with pack.open("a") as file:
        file.write(alarms)
    exit_code, out, err = run(capsys, "config", "check", pack)
    assert exit_code == code
    assert message in err
    assert ("valid; pack" in out) == (code == 0)


def test_show_prints_the_limits_in_effect(pack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pack.open("a") as file:
        file.write("soc_low = {limit = 0.2}\nhook = [{run = ['/bin/true'], dry_run = true}]\n")
    code, out, _ = run(capsys, "config", "show", pack)
    assert code == 0
    assert "# alarms.soc_low.clear = 0.25\n" in out
    assert "# alarms.pack_over_voltage.limit = 8.5\n" in out


@pytest.mark.parametrize(
    "command", [["alarms", "--cell", "nmc", "--capacity-ah", "10"], ["convert", "--out", "out.csv"]]
)
def test_a_capture_without_samples_is_an_error_that_names_the_fault_of_its_bytes(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with CaptureWriter(tmp_path / "capture.bms", CaptureHeader(mode="text")) as writer:
        for second in range(5):
            writer.write(float(second), b'{"voltage": 7.4}\n')
    name, *options = command
    err = error(run(capsys, name, tmp_path / "capture.bms", *options))
    assert "contains no sample: lines without voltage and current arrive; the first: '{" in " ".join(err.split())
