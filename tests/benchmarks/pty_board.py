"""A board on a pseudo-terminal that sends at a steady rate and knows when it sent what."""

import os
import threading
import time
import tty
from types import TracebackType
from typing import Self

import numpy as np
from load import pulses
from wire import hello, sample_frames

from bms_estimator.sources.protocol import Ack, AckResult, MessageType, ProtocolError, unseal

LONGEST_S = 120
HELLO_S = 0.1
"""Between two of its hellos before a host asks [s]."""


class PtyBoard:
    """Says hello until it is asked for it, and from then on sends a sample at each tick of its clock.

    Args:
        rate_hz: Samples per second.

    Attributes:
        sent: Samples written.
        sent_s: Shape (n,): monotonic time at which each was written [s].
    """

    def __init__(self, rate_hz: int) -> None:
        self.rate_hz = rate_hz
        self._frames = sample_frames(pulses(LONGEST_S * rate_hz, rate_hz))
        self.sent = 0
        self.sent_s = np.zeros(len(self._frames))
        self._board, self._line = os.openpty()
        tty.setraw(self._line)
        self.port = os.ttyname(self._line)
        self._stop, self._asked = threading.Event(), bytearray()
        self._thread = threading.Thread(target=self._live, name="board")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        os.close(self._board)
        os.close(self._line)

    def stop(self) -> None:
        """Send no more."""
        self._stop.set()
        self._thread.join()

    def _live(self) -> None:
        os.set_blocking(self._board, False)
        while not self._answer() and not self._stop.wait(HELLO_S):
            self._write(b"\0" + hello(self.rate_hz))  # a host asks only who has been heard
        started_s = time.monotonic()
        while not self._stop.wait(max(started_s + (self.sent + 1) / self.rate_hz - time.monotonic(), 0.0)):
            due = min(int((time.monotonic() - started_s) * self.rate_hz), len(self._frames))
            if due == len(self._frames):
                return
            if due > self.sent:
                self._write(self._frames[self.sent : due].tobytes())
                self.sent_s[self.sent : due] = time.monotonic()
                self.sent = due
            self._answer()

    def _answer(self) -> bool:
        """Answer what the host has asked. Returns whether it asked for the hello."""
        try:
            self._asked += os.read(self._board, 4096)
        except BlockingIOError:
            return False
        *frames, rest = bytes(self._asked).split(b"\0")
        self._asked = bytearray(rest)
        kinds = [self._kind(frame) for frame in frames]
        for kind in kinds:
            if kind == MessageType.COMMAND_HELLO:
                self._write(b"\0" + hello(self.rate_hz))
            elif kind is not None:
                self._write(Ack(kind, AckResult.OK, 1_000_000_000 // self.rate_hz).encode())
        return MessageType.COMMAND_HELLO in kinds

    @staticmethod
    def _kind(frame: bytes) -> int | None:
        try:
            return unseal(frame)[1]
        except ProtocolError:
            return None

    def _write(self, data: bytes) -> None:
        """Write all, waiting for room as a driver's buffer would."""
        view = memoryview(data)
        while view and not self._stop.is_set():
            try:
                view = view[os.write(self._board, view) :]
            except BlockingIOError:
                time.sleep(0.0005)
