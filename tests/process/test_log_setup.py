"""Log: lines of the configured levels, written without waiting for the reader of stderr."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import structlog

from bms_estimator.process import runtime, stderr_writer
from bms_estimator.process.runtime import configure_logs, set_level
from bms_estimator.process.stderr_writer import Stderr
from tests.patience import LONG_S


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Return the list that receives the log lines, with no level set by an earlier test."""
    monkeypatch.setattr(runtime, "_levels", {})
    lines, configuration = list[str](), structlog.get_config()
    configure_logs(lines)
    yield lines
    structlog.configure(**configuration)


def test_lowest_level_of_all_packs_applies_and_can_change(lines: list[str]) -> None:
    log = structlog.get_logger()
    log.info("written-without-level")
    set_level("a", "error")
    for level in ("info", "warning", "error"):
        getattr(log, level)(level)
    set_level("b", "warning")
    log.warning("written-for-b")
    log.info("below-both-levels")
    set_level("a", "info")
    log.info("written-for-a")
    assert [line.split()[-1] for line in lines] == [
        "written-without-level",
        "error",
        "written-for-b",
        "written-for-a",
    ]


@pytest.mark.parametrize("is_readable", [True, False])
def test_a_logged_exception_has_no_local_variables(
    lines: list[str], monkeypatch: pytest.MonkeyPatch, is_readable: bool
) -> None:
    if not is_readable:
        monkeypatch.setattr(runtime, "stderr", SimpleNamespace(put=lines.append))
        configure_logs()
    password = "not-for-the-log".upper()
    try:
        int(password[:0])
    except ValueError:
        structlog.get_logger().exception("failed")
    (line,) = lines
    assert "ValueError" in line
    assert password not in line


def test_lines_beyond_the_queue_are_counted_as_lost_and_queued_lines_keep_their_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reader_resumes, written = threading.Event(), []

    def write(_: int, data: bytes) -> int:
        assert reader_resumes.wait(LONG_S)
        written.append(data[:3])
        return min(len(data), 3)  # like a pipe, this accepts a part of the data

    monkeypatch.setattr(stderr_writer, "os", SimpleNamespace(write=write))
    monkeypatch.setattr(stderr_writer, "MAX_QUEUED_LINES", 4)
    out = Stderr()
    for i in range(20):
        out.put(f"line {i}")
    out.drain()  # returns after its timeout
    lost = out.lost
    assert 15 <= lost <= 16  # of 20 lines, 4 wait in the queue; the writer may have removed one more from it
    reader_resumes.set()
    while out._lines.unfinished_tasks:
        out.drain()
    assert b"".join(written).decode().splitlines() == [f"line {i}" for i in (*range(4), *([4] if lost == 15 else []))]
    assert out.lost == lost
