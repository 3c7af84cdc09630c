"""Keys of a terminal one by one, as they are pressed."""

import asyncio
import contextlib
import os
import sys
import termios
import tty
from collections.abc import Callable, Iterator

KEYS = {
    b"\t": "next",
    b"\x1b[B": "next",
    b"\x1b[C": "next",
    b"\x1bOB": "next",
    b"\x1bOC": "next",
    b"\x1b[Z": "previous",
    b"\x1b[A": "previous",
    b"\x1b[D": "previous",
    b"\x1bOA": "previous",
    b"\x1bOD": "previous",
    b"q": "quit",
}
"""Actions by the bytes that a terminal sends: Tab and the arrows, in both of their modes."""
LONGEST = 3
READ_BYTES = 1024


@contextlib.contextmanager
def keys(press: Callable[[str], None]) -> Iterator[None]:
    """Read key presses within the context; nothing where standard input is no terminal.

    Args:
        press: Called with one of the values of ``KEYS``.
    """
    if not (sys.stdin and sys.stdin.isatty()):
        yield
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    loop = asyncio.get_running_loop()

    def read() -> None:
        pressed = os.read(terminal, READ_BYTES)
        if not pressed:  # the terminal is gone
            loop.remove_reader(terminal)
        for meaning in meanings(pressed):
            press(meaning)

    tty.setcbreak(terminal)  # Ctrl-C still raises SIGINT
    loop.add_reader(terminal, read)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        with contextlib.suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(terminal, termios.TCSANOW, before)  # stop before all is written: there may be no reader


def meanings(pressed: bytes) -> Iterator[str]:
    """Return the actions of the keys in a terminal's input; skip keys without an action."""
    while pressed:
        for length in range(LONGEST, 0, -1):
            if pressed[:length] in KEYS:
                yield KEYS[pressed[:length]]
                break
        else:
            length = 1
        pressed = pressed[length:]
