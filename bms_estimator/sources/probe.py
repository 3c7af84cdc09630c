"""Asks whoever is on a serial port for a board's hello."""

import time

import serial

from bms_estimator.sources.frames import FrameDecoder
from bms_estimator.sources.ports import NoPortError, open_port
from bms_estimator.sources.protocol import BAUD, hello_command

PATIENCE_S = 3.0
"""A board that was reset by the opening of its port spends two seconds in its boot loader [s]."""
ASK_S = 0.5
READ_BYTES = 4096


def probe(port: str, baud: int = BAUD) -> str:
    """What is on ``port``, for people. Leaves the board's settings as they are.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Of the board [1/s].
    """
    try:
        with open_port(port, baud, ASK_S) as line:
            return _ask(line)
    except NoPortError as error:
        return str(error).removeprefix(f"{port}: ")
    except OSError as error:
        return f"lost: {error}"


def _ask(line: serial.Serial) -> str:
    decoder = FrameDecoder()
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        line.write(hello_command())
        decoder.feed(0.0, line.read(READ_BYTES if line.in_waiting else 1) + line.read(line.in_waiting))
        if decoder.hello is not None:
            board = decoder.board
            serial_number = f", serial {board['serial']}" if board["serial"] else ""
            return f"board, firmware {board['firmware']}{serial_number}, {board['sample_rate_hz']} Hz"
    if decoder.fault is not None:
        return decoder.fault.value
    return "no board answers" if decoder.counters.bytes_received else "silent"
