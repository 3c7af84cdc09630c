"""Real service with two packs: a board that prints text with cell voltages, and a board with the firmware's protocol."""

import asyncio
import contextlib
import json
import os
import subprocess
import threading
from pathlib import Path
from typing import Any

from bms_estimator.simulation.virtual_board import Reading, VirtualBoard
from tests.command_line import PROGRAM
from tests.mosquitto import Broker
from tests.patience import LONG_S
from tests.serial_line import Line

COMMANDS = ("set_soc", "current_zero", "acknowledge_alarm", "publish_rate")
PACK_FILE = """
[pack]
name = "{name}"
{cell}
initial_soc = 0.5
[sensor]
port = "{port}"
protocol = "{protocol}"
[publish]
rate_hz = 2
[mqtt]
url = "{url}"
commands = {commands}
"""
LFP_PACK = 'cell = "lfp"\ncapacity_ah = 100\nseries = 4'
SOC_LOW_SECTION = "[alarms]\nsoc_low = {limit = 0.1, clear = 0.2, delay_s = 0, clear_delay_s = 0}\n"
PRINT_INTERVAL_S = 0.1
"""Interval of the printed lines [s]."""


class Packs:
    """Service of the packs ``pack`` (text board) and ``bench`` (board with the firmware's protocol), and their boards.

    Attributes:
        printed: Values that the text board prints.
        silent: While this event is set, the text board prints nothing.
    """

    def __init__(self, folder: Path, broker: Broker) -> None:
        self._folder = folder
        self._line = Line(folder / "printing-board")
        self._board = VirtualBoard(lambda _: Reading(0.0, 3.7, 25.0), rate_hz=10)
        self._ended = threading.Event()
        self.silent = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        cells_v = [3.301, 3.302, 3.28, 3.303]
        self.printed: dict[str, Any] = {"voltage": sum(cells_v), "current": 2.0, "temp": 21.5, "cells": cells_v}
        shared_settings = {"url": broker.url, "commands": list(COMMANDS)}
        self._line.plug()
        self._board.__enter__()
        texts = {
            "pack": PACK_FILE.format(
                name="pack", cell=LFP_PACK, port=self._line.path, protocol="text", **shared_settings
            )
            + SOC_LOW_SECTION,
            "bench": PACK_FILE.format(
                name="bench", cell='cell = "chen_mora"', port=self._board.path, protocol="binary", **shared_settings
            ),
        }
        self._files = [folder / f"{name}.toml" for name in texts]
        for file, text in zip(self._files, texts.values(), strict=True):
            file.write_text(text)
        self._threads = [threading.Thread(target=self._print), threading.Thread(target=self._sample)]
        for thread in self._threads:
            thread.start()

    def start(self) -> None:
        """Start the service. The boards run already."""
        environment = os.environ | {"XDG_STATE_HOME": str(self._folder)}
        with (self._folder / "service.log").open("ab") as log:
            command = [str(PROGRAM), "run", *map(str, self._files)]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(LONG_S)
            self._process = None

    def close(self) -> None:
        self.kill()
        self._ended.set()
        for thread in self._threads:
            thread.join(LONG_S)
        self._line.unplug()
        self._board.__exit__()

    @property
    def log(self) -> str:
        return (self._folder / "service.log").read_text()

    def _print(self) -> None:
        """Print the lines of the text board until the end."""
        with contextlib.suppress(OSError):  # no process has opened the line yet
            self._line.received()  # makes writes to a full line fail instead of block
        while not self._ended.wait(PRINT_INTERVAL_S):
            with contextlib.suppress(OSError):  # the line is full or not open
                if not self.silent.is_set():
                    self._line.write(json.dumps(self.printed).encode() + b"\r\n")

    def _sample(self) -> None:
        """Run the virtual board until the end."""

        async def sample() -> None:
            running = asyncio.create_task(self._board.run())
            while not self._ended.is_set():  # noqa: ASYNC110 - an event of another thread
                await asyncio.sleep(PRINT_INTERVAL_S)
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

        asyncio.run(sample())
