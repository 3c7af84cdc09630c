"""A serial line for tests: a PTY under a stable name that can be unplugged and plugged in again."""

import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest


class Line:
    """The board's end of the line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1

    def plug(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            self._master = -1
            self.path.unlink()

    def write(self, data: bytes) -> None:
        os.write(self._master, data)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    line = Line(tmp_path / "board")
    yield line
    line.unplug()
