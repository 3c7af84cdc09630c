"""Commands read the exports of cyclers without options, from files and standard input, and print what was guessed."""

import io
import json
import sys
from pathlib import Path

import pytest

from bms_estimator.cli.main import COMMANDS
from tests.command_line import error, run
from tests.sources.captures.binary_exports import arbin_sheets, write_mpr, write_nda, write_xlsx
from tests.sources.captures.cycler_exports import EXPORTS, arbin, german, measure

READERS_OF_CAPTURES = (
    *("replay", "alarms", "validate", "convert", "report", "thesis"),
    *("calibrate", "identify", "capacity", "ocv", "adapt"),
)


def test_replay_reads_all_exports_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    final_socs = []
    for export in EXPORTS:
        path = export.save(tmp_path)
        code, out, err = run(capsys, "replay", path, "--cell", "ncr18650", "--json")
        assert (code, err.count("\n")) == (0, 1), err
        assert err.startswith(f"{path.name}: read as {export.dialect} (")
        if not export.has_temperature:  # the estimate depends on the temperature
            final_socs.append(json.loads(out)["soc_final"])
    assert final_socs == pytest.approx([final_socs[0]] * len(final_socs), abs=1e-9)


def test_validate_reads_an_export_from_standard_input(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = german(measure()).encode("latin-1")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(table)))
    code, out, err = run(capsys, "validate", "-", "--cell", "ncr18650", "--json")
    assert code == 0, err
    assert json.loads(out)["samples"] > 0
    assert err.startswith(
        'stdin: read as unknown program (text, separator semicolon, decimal comma): time "Zeit" in min'
    )


@pytest.mark.usefixtures("empty_plots")
def test_report_reads_an_export_from_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = arbin(measure()).replace("Current (A)", "Load (A)").encode()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(table)))
    column_map = "time=Test Time (s),current=Load (A),voltage=Voltage (V)"
    out = tmp_path / "report.html"
    code, _, err = run(capsys, "report", "-", "--cell", "ncr18650", "--map", column_map, "--out", out)
    assert code == 0, err
    assert err.startswith("stdin: read as Arbin with given columns")
    assert "report on stdin" in out.read_text(encoding="utf-8")


def test_mapped_columns_are_used_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cell.csv"
    path.write_text(arbin(measure()).replace("Current (A)", "Load (A)"))
    code, _, err = run(capsys, "replay", path, "--cell", "ncr18650")
    assert (code, "no column of current" in err) == (2, True)
    column_map = "time=Test Time (s),current=Load (A),voltage=Voltage (V)"
    code, _, err = run(capsys, "replay", path, "--cell", "ncr18650", "--map", column_map)
    assert code == 0
    assert "read as Arbin with given columns" in err
    assert 'current "Load (A)" in A, positive on charge (convention of Arbin)' in err


@pytest.mark.parametrize("command", READERS_OF_CAPTURES)
def test_every_command_that_reads_captures_has_the_option_map(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command in COMMANDS
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert "--map" in out


@pytest.mark.parametrize(
    ("package", "extra", "name"),
    [("python_calamine", "excel", "cell.xlsx"), ("fastnda", "cycler", "cell.nda"), ("galvani", "cycler", "cell.mpr")],
)
def test_missing_package_is_reported_with_its_extra(
    package: str,
    extra: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, measurement = tmp_path / name, measure()
    {
        "cell.xlsx": lambda: write_xlsx(path, arbin_sheets(measurement)),
        "cell.nda": lambda: write_nda(path, measurement),
        "cell.mpr": lambda: write_mpr(path, measurement),
    }[name]()
    monkeypatch.setitem(sys.modules, package, None)  # its import fails
    err = error(run(capsys, "replay", path, "--cell", "ncr18650"))
    assert f"this command needs the package {package}: pip install 'bms_estimator[{extra}]'" in err
