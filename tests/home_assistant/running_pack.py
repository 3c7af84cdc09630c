"""Real service of a pack whose board prints text with cell voltages."""

import contextlib
import json
import os
import subprocess
import threading
from pathlib import Path
from typing import Any

from tests.command_line import PROGRAM
from tests.mosquitto import Broker
from tests.patience import LONG_S
from tests.serial_line import Line

PACK_FILE = """
[pack]
name = "pack"
cell = "lfp"
capacity_ah = 100
series = 4
initial_soc = 0.5
[sensor]
port = "{port}"
protocol = "text"
[publish]
rate_hz = 2
[mqtt]
url = "{url}"
commands = ["set_soc", "current_zero", "acknowledge_alarm", "publish_rate"]
[alarms]
soc_low = {{limit = 0.1, clear = 0.2, delay_s = 0, clear_delay_s = 0}}
"""
PRINT_INTERVAL_S = 0.1
"""Interval of the printed lines [s]."""
CELLS_V = [3.301, 3.302, 3.28, 3.303]
PRINTED: dict[str, Any] = {"voltage": sum(CELLS_V), "current": 2.0, "temp": 21.5, "cells": CELLS_V}
"""Values that the board prints."""


class RunningPack:
    """Service of the pack ``pack``, and its board.

    Attributes:
        silent: While this event is set, the board prints nothing.
    """

    def __init__(self, folder: Path, broker: Broker) -> None:
        self.silent, self._ended = threading.Event(), threading.Event()
        self._line = Line(folder / "printing-board")
        self._line.plug()
        file = folder / "pack.toml"
        file.write_text(PACK_FILE.format(port=self._line.path, url=broker.url))
        self._thread = threading.Thread(target=self._print)
        self._thread.start()
        command, environment = [PROGRAM, "run", file], os.environ | {"XDG_STATE_HOME": str(folder)}
        with (folder / "service.log").open("ab") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)

    def close(self) -> None:
        self._process.kill()
        self._process.wait(LONG_S)
        self._ended.set()
        self._thread.join(LONG_S)
        self._line.unplug()

    def _print(self) -> None:
        """Print the lines of the board until the end."""
        with contextlib.suppress(OSError):  # no process has opened the line yet
            self._line.received()  # makes writes to a full line fail instead of block
        while not self._ended.wait(PRINT_INTERVAL_S):
            with contextlib.suppress(OSError):  # the line is full or not open
                if not self.silent.is_set():
                    self._line.write(json.dumps(PRINTED).encode() + b"\r\n")
