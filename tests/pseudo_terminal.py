"""Program ``bms-estimator`` on a pseudo-terminal of any size."""

import fcntl
import os
import re
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable
from typing import Self

from tests.command_line import PROGRAM
from tests.patience import LONG_S

ALTERNATE, BACK, CURSOR = "\x1b[?1049h", "\x1b[?1049l", "\x1b[?25h"
"""Control sequences: enter and leave the alternate screen, show the cursor."""


class PseudoTerminal:
    """``bms-estimator ARGUMENTS`` with a terminal as standard output and standard error.

    Attributes:
        output: Output read so far.
        process: The program.
    """

    def __init__(self, *arguments: str, columns: int = 80, rows: int = 24) -> None:
        self._arguments = arguments
        self.output = ""
        self._master, self._slave = os.openpty()
        self.resize(columns, rows)

    def __enter__(self) -> Self:
        self.settings = termios.tcgetattr(self._slave)
        command = [PROGRAM, *self._arguments]
        # COLUMNS and LINES of the shell that started the tests would override the size of the terminal.
        env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            command,
            stdin=self._slave,
            stdout=self._slave,
            stderr=self._slave,
            env=env | {"TERM": "xterm-256color"},
            preexec_fn=accept_interrupts,  # noqa: PLW1509 - it only sets a signal handler
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)
        os.close(self._slave)

    def resize(self, columns: int, rows: int) -> None:
        self._rows = rows
        fcntl.ioctl(self._slave, termios.TIOCSWINSZ, struct.pack("4H", rows, columns, 0, 0))

    def press(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def read(self) -> None:
        """Read the available output, or wait up to 0.1 s for it."""
        if select.select([self._master], [], [], 0.1)[0]:
            self.output += os.read(self._master, 1 << 16).decode(errors="replace")

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + LONG_S
        while not condition():
            assert time.monotonic() < deadline, f"the expected output never appeared: {self.screen()}"
            self.read()

    def ended(self) -> bool:
        return self.process.poll() is not None

    def screen(self) -> list[str]:
        """Return the lines on the screen without control sequences. Each is written after a move of the cursor to its row."""
        moves = re.split(r"\x1b\[(\d+);1H", self.output.split(ALTERNATE)[-1])[1:]
        rows = {
            int(row): re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", text)
            for row, text in zip(moves[::2], moves[1::2], strict=True)
        }
        return [rows[row] for row in sorted(rows) if row <= self._rows]

    def is_as_before(self) -> bool:
        """Return True if the program has restored the settings of the terminal."""
        return termios.tcgetattr(self._slave) == self.settings


def accept_interrupts() -> None:
    """Give SIGINT its default effect. A shell lets programs in the background ignore it, also the tests."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
