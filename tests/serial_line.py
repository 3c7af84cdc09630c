"""A serial line for tests: a PTY under a stable name that can be unplugged and plugged in again."""

import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo


def usb_port(device: str, vid: int = 0x1A86, pid: int = 0x7523, product: str = "USB Serial") -> ListPortInfo:
    """A port as pyserial lists it; without more a CH340's."""
    port = ListPortInfo(device)
    port.vid, port.pid, port.product, port.description = vid, pid, product, product
    return port


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

    def heard(self) -> bytes:
        """What the host has sent."""
        os.set_blocking(self._master, False)
        try:
            return os.read(self._master, 1 << 16)
        except BlockingIOError:
            return b""


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    line = Line(tmp_path / "board")
    yield line
    line.unplug()
