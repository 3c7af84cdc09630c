"""Asks whoever is on a serial port, one thing at a time: for a board's hello, and to keep a setting."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self, TypeVar

from bms_estimator.model.errors import UserError
from bms_estimator.model.settings import SensorSettings
from bms_estimator.sources.dialects import Dialect
from bms_estimator.sources.dialects.board import ASK_AGAIN_S, BoardDialect
from bms_estimator.sources.dialects.table import DIALECTS
from bms_estimator.sources.dialects.text import TextDialect
from bms_estimator.sources.frames import FrameFault
from bms_estimator.sources.ports import NoPortError, open_port
from bms_estimator.sources.protocol import BAUD, Hello, set_rate_command

if TYPE_CHECKING:
    import serial

PATIENCE_S = 3.0
"""A board that was reset by the opening of its port spends two seconds in its boot loader [s]."""
READ_BYTES = 4096
REFERENCE_RATE_HZ = 100
"""The firmware's own: the bandgap is measured in every second sample, or in each without an NTC."""
REFERENCE_SAMPLES = 300
"""Of them the noise of the bandgap's mean is 0.03 %."""
REFERENCE_S = 10.0
"""So long may they take [s]."""

Answer = TypeVar("Answer")


def probe(port: str, baud: int = BAUD) -> str:
    """What is on ``port``, for people. Leaves a board's settings as they are; what is not understood is sent nothing.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Of the board [1/s].
    """
    dialects = [make(SensorSettings()) for make in DIALECTS.values()]
    try:
        with open_port(port, baud, ASK_AGAIN_S) as line:
            found = _converse(line, dialects, lambda: next((d.described for d in dialects if d.described), None))
    except NoPortError as error:
        return str(error).removeprefix(f"{port}: ")
    except OSError as error:
        return f"lost: {error}"
    return found or _silence(dialects)


class AskedBoard:
    """A board that does nothing but answer; a context manager.

    Args:
        port: Device path; opened for ourselves alone.
        baud: Of the board [1/s].

    Raises:
        NoPortError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self._port, self._line = port, open_port(port, baud, ASK_AGAIN_S)
        self._board, self._text = BoardDialect(), TextDialect()

    def __enter__(self) -> Self:
        """The board."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port."""
        self._line.close()

    def hello(self) -> Hello:
        """What the board says of itself, after the last command.

        Raises:
            UserError: No board answers; the message says what is there instead.
        """
        return self._ask([self._board, self._text], lambda: self._board.hello)

    def tell(self, frame: bytes) -> Hello:
        """Give a command that may be given twice. Returns the hello after it.

        Raises:
            UserError: The board refuses, or does not answer.
        """
        command = self._board.tell(frame)
        self._ask([self._board, self._text], lambda: command.done or None)
        if command.refusal:
            raise UserError(f"{self._port}: {command.refusal}")
        return self.hello()

    def reference_v(self) -> float:
        """Full range of its converter as its bandgap tells now [V]; what it measured at its reset may be long ago.

        The board samples at ``REFERENCE_RATE_HZ`` from then on.

        Raises:
            UserError: As ``tell``.
        """
        hello = self.tell(set_rate_command(REFERENCE_RATE_HZ))
        now = BoardDialect()
        now.feed(0.0, replace(hello, bandgap_sum=0, bandgap_count=0).encode())

        def measured() -> float | None:
            return now.reference_v if now.counters["frames_received"] >= REFERENCE_SAMPLES else None

        return self._ask([now], measured, REFERENCE_S)

    def _ask(
        self, dialects: Sequence[Dialect], answer: Callable[[], Answer | None], patience_s: float | None = None
    ) -> Answer:
        """The answer.

        Raises:
            UserError: There is none.
        """

        def answer_or_text() -> Answer | None:
            if self._text.described:
                raise UserError(f"{self._port}: {FrameFault.TEXT.value}; it takes no commands")
            return answer()

        try:
            answered = _converse(self._line, dialects, answer_or_text, patience_s)
        except OSError as error:
            raise UserError(f"{self._port}: lost: {error}") from None
        if answered is None:
            raise UserError(f"{self._port}: {_silence(dialects)}")
        return answered


def _converse(
    line: "serial.Serial",
    dialects: Sequence[Dialect],
    answer: Callable[[], Answer | None],
    patience_s: float | None = None,
) -> Answer | None:
    """Have dialects hear and talk until there is an answer; None where none comes.

    Raises:
        OSError: The port is lost.
    """
    end_s = time.monotonic() + (PATIENCE_S if patience_s is None else patience_s)
    while (now_s := time.monotonic()) < end_s:
        if (answered := answer()) is not None:
            return answered
        for dialect in dialects:
            line.write(dialect.due(now_s))
        data = line.read(max(1, min(line.in_waiting, READ_BYTES)))
        for dialect in dialects:
            dialect.feed(now_s, data)
    return answer()


def _silence(dialects: Sequence[Dialect]) -> str:
    """Why none of them knows who is there."""
    if not dialects[0].counters["bytes_received"]:
        return "silent"
    return next((dialect.fault for dialect in dialects if dialect.fault), "no board answers")
