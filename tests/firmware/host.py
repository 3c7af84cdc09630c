"""Host at the serial line of a board, which reads and sends single messages."""

import os
import select
import time
from collections.abc import Callable
from typing import Self

from bms_estimator.protocols.firmware.messages import Ack, Hello, MessageType, ProtocolError, SampleMessage, unseal
from tests.patience import LONG_S


class Host:
    """Host that stores all messages of the board.

    Attributes:
        samples: Received samples.
        hellos: Received hellos, each with the number of samples before it.
        acks: Received acknowledgments.
        bad: Invalid frames.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._rest = b""
        self.samples: list[SampleMessage] = []
        self.hellos: list[tuple[int, Hello]] = []
        self.acks: list[Ack] = []
        self.bad: list[bytes] = []

    def __enter__(self) -> Self:
        self._fd = os.open(self._path, os.O_RDWR | os.O_NOCTTY)  # pyserial would flush the first bytes
        self.until(lambda: bool(self.hellos))  # before its hello the board ignores commands
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def send(self, data: bytes) -> None:
        os.write(self._fd, data)

    def read(self) -> None:
        """Store the messages that have arrived. Wait up to 0.1 s for bytes."""
        if not select.select([self._fd], [], [], 0.1)[0]:
            return
        *frames, self._rest = (self._rest + os.read(self._fd, 1 << 16)).split(b"\0")
        for frame in filter(None, frames):
            try:
                self._take(unseal(frame))
            except ProtocolError:
                self.bad.append(frame)

    def _take(self, packet: bytes) -> None:
        match packet[1]:
            case MessageType.SAMPLE:
                self.samples.append(SampleMessage.decode(packet))
            case MessageType.HELLO:
                self.hellos.append((len(self.samples), Hello.decode(packet)))
            case _:
                self.acks.append(Ack.decode(packet))

    def until(self, condition: Callable[[], bool]) -> None:
        """Read until the condition is true."""
        deadline = time.monotonic() + LONG_S
        while not condition():
            assert time.monotonic() < deadline, "the board did not bring what was wanted"
            self.read()

    def take(self, samples: int) -> list[SampleMessage]:
        """Wait for the next ``samples`` samples. Return them."""
        begin = len(self.samples)
        self.until(lambda: len(self.samples) >= begin + samples)
        return self.samples[begin : begin + samples]

    def hello(self) -> Hello:
        """Wait for the next hello. Return it."""
        begin = len(self.hellos)
        self.until(lambda: len(self.hellos) > begin)
        return self.hellos[begin][1]

    def ask(self, command: bytes) -> Ack:
        """Send a command. Return its acknowledgment."""
        begin = len(self.acks)
        self.send(command)
        self.until(lambda: len(self.acks) > begin)
        return self.acks[begin]
