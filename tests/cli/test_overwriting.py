"""``--out`` replaces a file only with ``--force``, and an input that is given twice is rejected."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.simulated_relaxation import relaxation
from tests.command_line import run


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Write a capture of a simulated cell with rests."""
    path = tmp_path_factory.mktemp("capture") / "rests.csv"
    rows = relaxation()[["time_s", "current_a", "voltage_v"]]
    np.savetxt(path, rows, delimiter=",", header="time_s,current_a,voltage_v", comments="", fmt="%.6f")
    return path


@pytest.mark.parametrize(
    ("command", "options", "out_name", "lines"),
    [
        ("replay", ("--cell", "ncr18650"), "out.csv", 600),
        ("ocv", ("--capacity-ah", "3"), "out.toml", None),
        ("identify", ("--cell", "ncr18650", "--keep-ocv"), "out.toml", None),
    ],
)
def test_existing_file_is_replaced_only_with_force(command, options, out_name, lines, capture, tmp_path, capsys):
    """``lines`` is the number of lines of the capture that the command needs; None: all."""
    out, used = tmp_path / out_name, tmp_path / "capture.csv"
    used.write_text("\n".join(capture.read_text().splitlines()[:lines]) + "\n")
    out.write_text("# measured in May\n")
    arguments = command, used, *options, "--out", out
    code, _, err = run(capsys, *arguments)
    assert (code, f"error: --out {out}: exists already; --force replaces it" in err) == (2, True)
    assert out.read_text() == "# measured in May\n"
    assert run(capsys, *arguments, "--force")[0] == 0
    assert len(out.read_text().splitlines()) > 10


@pytest.mark.parametrize(
    "command",
    [
        ("ocv", "--capacity-ah", "3", "--out", "mine.toml"),
        ("identify", "--cell", "ncr18650", "--out", "mine.toml"),
        ("thesis", "--cell", "ncr18650", "--out", "report"),
    ],
    ids=lambda command: command[0],
)
@pytest.mark.parametrize(
    ("make_duplicate", "message"),
    [(Path.symlink_to, "given twice"), (lambda again, path: shutil.copy(path, again), "has the same content as")],
    ids=["link", "copy"],
)
def test_duplicate_capture_is_rejected(command, make_duplicate, message, capture, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    again = tmp_path / "again.csv"
    make_duplicate(again, capture)
    code, _, err = run(capsys, command[0], capture, again, *command[1:])
    assert (code, f"error: again.csv: {message}" in err.replace(f"{tmp_path}/", "")) == (2, True)
    assert "the capture would count twice" in err
    assert not list(tmp_path.glob("mine*"))


def test_missing_folder_is_an_error_before_the_computation(capture, tmp_path, capsys):
    out = tmp_path / "missing" / "report.html"
    code, _, err = run(capsys, "report", capture, "--cell", "ncr18650", "--out", out)
    assert (code, f"there is no folder {out.parent}; create it" in err) == (2, True)


def test_full_disk_leaves_the_old_file(capture, full_disk, capsys, monkeypatch):
    out = full_disk / "mine.toml"
    monkeypatch.setattr("bms_estimator.model.pack_model.cell_text", lambda *_: "x" * 8192)
    out.touch()
    (full_disk / "file").unlink()
    out.write_text("# measured in May\n")
    (full_disk / "file").write_bytes(b"")
    code, _, err = run(capsys, "ocv", capture, "--capacity-ah", "3", "--out", out, "--force")
    assert (code, "cannot be written: No space left on device" in err) == (1, True)
    assert out.read_text() == "# measured in May\n"
    assert sorted(path.name for path in full_disk.iterdir()) == ["file", "mine.toml"]
