"""Serial line for tests: a pseudo-terminal with a fixed path that can be unplugged and plugged in again."""

import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo


def usb_port(device: str, vid: int = 0x1A86, pid: int = 0x7523, product: str = "USB Serial") -> ListPortInfo:
    """Return a USB port as pyserial lists it; by default that of a CH340."""
    port = ListPortInfo(device)
    port.vid, port.pid, port.product, port.description = vid, pid, product, product
    return port


class Line:
    """The board's end of a serial line."""

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

    def received(self) -> bytes:
        """Return the bytes that the host has sent since the last call."""
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
