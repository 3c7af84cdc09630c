"""Key presses on a terminal, read one by one."""

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
"""Actions by the bytes that a terminal sends: Tab, and arrow keys in normal and application mode."""
MAX_SEQUENCE = 3
"""Maximum length of a key's byte sequence."""
READ_BYTES = 1024
"""Maximum number of bytes read at once."""


@contextlib.contextmanager
def keys(press: Callable[[str], None]) -> Iterator[None]:
    """Read key presses within the context, if standard input is a terminal.

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
        for action in actions(pressed):
            press(action)

    tty.setcbreak(terminal)  # Ctrl-C still raises SIGINT
    loop.add_reader(terminal, read)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        with contextlib.suppress(termios.error):  # the terminal is gone
            # TCSANOW does not wait for the output, whose reader may be gone
            termios.tcsetattr(terminal, termios.TCSANOW, before)


def actions(pressed: bytes) -> Iterator[str]:
    """Yield the actions of the keys in a terminal's input; skip keys without an action."""
    while pressed:
        for length in range(MAX_SEQUENCE, 0, -1):
            if pressed[:length] in KEYS:
                yield KEYS[pressed[:length]]
                break
        else:
            length = 1
        pressed = pressed[length:]
