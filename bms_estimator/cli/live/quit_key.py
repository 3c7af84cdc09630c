"""Quit the program when the key q is pressed in its terminal, without Enter."""

import asyncio
import contextlib
import os
import sys
import termios
import tty
from collections.abc import Callable, Iterator

QUIT_KEY = b"q"
READ_BYTES = 1024
"""Maximum number of bytes read at a time."""


@contextlib.contextmanager
def quit_key(quit_program: Callable[[], object]) -> Iterator[None]:
    """Read key presses within the context, if standard input is a terminal.

    Args:
        quit_program: Called when q is pressed.
    """
    if not (sys.stdin and sys.stdin.isatty()):
        yield
        return
    terminal = sys.stdin.fileno()
    previous_mode = termios.tcgetattr(terminal)
    loop = asyncio.get_running_loop()

    def read() -> None:
        pressed = os.read(terminal, READ_BYTES)
        if not pressed:  # the terminal is gone
            loop.remove_reader(terminal)
        if QUIT_KEY in pressed:
            quit_program()

    tty.setcbreak(terminal)  # Ctrl-C still raises SIGINT
    loop.add_reader(terminal, read)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        with contextlib.suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(
                terminal, termios.TCSANOW, previous_mode
            )  # do not wait for output: the terminal may be blocked
