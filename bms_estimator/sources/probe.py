"""Asks whoever is on a serial port, one thing at a time: for a board's hello, and to keep a setting."""

import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Self, TypeVar

from bms_estimator.model.errors import UserError
from bms_estimator.sources.frames import FrameDecoder, FrameFault, is_text
from bms_estimator.sources.ports import NoPortError, open_port
from bms_estimator.sources.protocol import BAUD, AckResult, Hello, hello_command, set_rate_command, unseal

PATIENCE_S = 3.0
"""A board that was reset by the opening of its port spends two seconds in its boot loader [s]."""
ASK_S = 0.5
"""What has not been answered for so long is asked again [s]."""
READ_BYTES = 4096
TEXT_BYTES = 16
"""Noise is hardly ever so many printable bytes in a row."""
REFERENCE_RATE_HZ = 100
"""The firmware's own: the bandgap is measured in every second sample, or in each without an NTC."""
REFERENCE_SAMPLES = 300
"""Of them the noise of the bandgap's mean is 0.03 %."""
REFERENCE_S = 10.0
"""So long may they take [s]."""

Answer = TypeVar("Answer")


def probe(port: str, baud: int = BAUD) -> str:
    """What is on ``port``, for people. Leaves the board's settings as they are.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Of the board [1/s].
    """
    try:
        with AskedBoard(port, baud) as board:
            hello = board.hello()
    except (NoPortError, UserError) as error:
        return str(error).removeprefix(f"{port}: ")
    serial_number = f", serial {hello.serial:08x}" if hello.serial else ""
    return f"board, firmware {hello.firmware}{serial_number}, {hello.rate_hz} Hz"


class AskedBoard:
    """A board that does nothing but answer; a context manager.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Of the board [1/s].

    Raises:
        NoPortError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._line = port, open_port(port, baud, ASK_S)
        self._decoder = FrameDecoder()
        self._tail = b""

    def __enter__(self) -> Self:
        """The board."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self._line.close()

    def hello(self) -> Hello:
        """What the board says of itself now.

        Raises:
            UserError: No board answers; the message says what is there instead.
        """
        self._decoder.forget_hello()
        return self._ask(hello_command(), lambda: self._decoder.hello)

    def tell(self, frame: bytes) -> Hello:
        """Give a command that may be given twice. Returns the hello after it.

        Raises:
            UserError: The board refuses, or does not answer.
        """
        kind = unseal(frame)[1]
        ack = self._ask(frame, lambda: next((a for a in self._decoder.take_acks() if a.command == kind), None))
        if ack.result != AckResult.OK:
            raise UserError(f"{self._port}: the board refuses: {ack.result.name.lower().replace('_', ' ')}")
        return self.hello()

    def reference_v(self) -> float:
        """Full range of its converter as its bandgap tells now [V]; what it measured at its reset may be long ago.

        The board samples at ``REFERENCE_RATE_HZ`` from then on.

        Raises:
            UserError: As ``tell``.
        """
        hello = self.tell(set_rate_command(REFERENCE_RATE_HZ))
        self._decoder = FrameDecoder()
        self._decoder.feed(0.0, replace(hello, bandgap_sum=0, bandgap_count=0).encode())
        return self._ask(b"", self._measured, REFERENCE_S)

    def _measured(self) -> float | None:
        enough = self._decoder.counters.frames_received >= REFERENCE_SAMPLES
        return self._decoder.reference_v if enough else None

    def _ask(self, frame: bytes, answer: Callable[[], Answer | None], patience_s: float | None = None) -> Answer:
        """Send ``frame`` until what comes is an answer."""
        now_s = ask_s = time.monotonic()
        end_s = now_s + (PATIENCE_S if patience_s is None else patience_s)
        try:
            while now_s < end_s:
                if now_s >= ask_s:
                    self._line.write(frame)
                    ask_s = now_s + ASK_S
                self._hear(self._line.read(max(1, min(self._line.in_waiting, READ_BYTES))))
                if (answered := answer()) is not None:
                    return answered
                now_s = time.monotonic()
        except OSError as error:
            raise UserError(f"{self._port}: lost: {error}") from None
        raise UserError(f"{self._port}: {self._silence()}")

    def _hear(self, data: bytes) -> None:
        self._decoder.feed(0.0, data)
        self._tail = (self._tail + data)[-TEXT_BYTES:]

    def _silence(self) -> str:
        """Why there is no answer."""
        if len(self._tail) == TEXT_BYTES and is_text(self._tail):
            return f"{FrameFault.TEXT.value}; it takes no commands"
        if self._decoder.fault is not None:
            return self._decoder.fault.value
        return "no board answers" if self._decoder.counters.bytes_received else "silent"
