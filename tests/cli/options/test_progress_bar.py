"""Progress bar on a terminal, and its absence elsewhere."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bms_estimator.cli.options import capture_input
from bms_estimator.cli.options.progress_bar import ProgressBar, progress_bar
from tests.command_line import run
from tests.pseudo_terminal import PseudoTerminal

ROWS = 40


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Return a capture of a constant load."""
    path = tmp_path / "load.csv"
    rows = "".join(f"{second},1.0,{3.9 - 1e-4 * second:.4f}\n" for second in range(ROWS))
    path.write_text(f"time_s,current_a,voltage_v\n{rows}")
    return path


def percentages(output: str) -> Iterator[int]:
    """Yield the percentages of the bars in the output of a terminal."""
    for match in re.finditer(r"replaying.*?(\d+)%", re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", output)):
        yield int(match[1])


@pytest.mark.parametrize("command", ["replay", pytest.param("alarms", marks=pytest.mark.thorough)])
def test_a_terminal_shows_a_bar_that_ends_at_100_percent_and_disappears(command: str, capture: Path) -> None:
    with PseudoTerminal(command, str(capture), "--cell", "ncr18650") as terminal:
        terminal.until(terminal.ended)
        terminal.read()
        assert terminal.process.returncode == 0
    shown = list(percentages(terminal.output))
    assert (shown[0], shown[-1]) == (0, 100)
    erased = terminal.output.rindex("\x1b[2K")  # control sequence that erases the line of the bar
    assert "%" in terminal.output[:erased]
    assert not list(percentages(terminal.output[erased:]))


@pytest.mark.parametrize("arguments", [("convert", "--out", "out.csv"), ("validate", "--cell", "ncr18650")])
def test_a_bar_is_shown_while_a_long_file_is_read(
    arguments: tuple[str, ...], capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = []

    @contextmanager
    def recorded_bar(label: str) -> Iterator[ProgressBar]:
        with progress_bar(label) as bar:
            monkeypatch.setattr(bar, "update", lambda fraction: labels.append((label, fraction)))
            yield bar

    monkeypatch.chdir(capture.parent)
    monkeypatch.setattr(capture_input, "LONG_FILE_BYTES", 100)
    monkeypatch.setattr(capture_input, "progress_bar", recorded_bar)
    assert run(capsys, arguments[0], capture.name, *arguments[1:])[0] == 0
    assert [fraction for _, fraction in labels][-1] == 1.0
    assert labels[0][0].endswith("load.csv")


@pytest.mark.parametrize("command", ["replay", "alarms"])
def test_a_pipe_receives_no_bar(command: str, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, command, capture, "--cell", "ncr18650")
    assert (code, err) == (0, "")
