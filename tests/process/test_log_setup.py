"""Log: lines of the configured levels, written without waiting for the reader of stderr."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import structlog

from bms_estimator.process import log_setup, stderr_writer
from bms_estimator.process.log_setup import configure_logs, set_level
from bms_estimator.process.stderr_writer import Stderr
from tests.patience import LONG_S


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    monkeypatch.setattr(log_setup, "_levels", {})
    lines: list[str] = []
    configure_logs(lines)
    yield lines
    structlog.reset_defaults()


def test_level_is_the_lowest_of_all_packs_and_can_change(lines: list[str]) -> None:
    log = structlog.get_logger()
    log.info("1")
    set_level("a", "error")
    for level in ("info", "warning", "error"):
        getattr(log, level)("2")
    set_level("b", "warning")
    log.warning("3")
    log.info("4")
    set_level("a", "info")
    log.info("5")
    assert [line.split()[-1] for line in lines] == ["1", "2", "3", "5"]


def test_unread_lines_are_counted_and_queued_ones_keep_their_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    release, written = threading.Event(), []

    def write(_: int, data: bytes) -> int:
        assert release.wait(LONG_S)
        written.append(data[:3])
        return min(len(data), 3)  # like a pipe, this accepts a part of the data

    monkeypatch.setattr(stderr_writer, "os", SimpleNamespace(write=write))
    monkeypatch.setattr(stderr_writer, "MAX_QUEUED_LINES", 4)
    out = Stderr()
    for i in range(20):
        out.take(f"line {i}")
    out.drain()  # returns after its timeout
    lost = out.lost
    assert 15 <= lost <= 16  # the writer may already have removed one line from the queue of four
    release.set()
    while out._lines.unfinished_tasks:
        out.drain()
    assert b"".join(written).decode().splitlines() == [f"line {i}" for i in (*range(4), *([4] if lost == 15 else []))]
    assert out.lost == lost
