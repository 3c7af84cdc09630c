"""Host at the serial line of a board. Tests send single commands and read single messages with it."""

import os
import select
import time
from collections.abc import Callable
from typing import Self

from bms_estimator.protocols.firmware.messages import Ack, Hello, MessageType, ProtocolError, SampleMessage, unseal
from tests.patience import LONG_S


class Host:
    """Host that stores all messages of the board. On entry it waits for the first hello.

    Attributes:
        samples: Received samples.
        hellos: Received hellos, each with the number of samples before it.
        acks: Received acknowledgments.
        invalid_frames: Received frames that are no valid message.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._partial_frame = b""
        self.samples: list[SampleMessage] = []
        self.hellos: list[tuple[int, Hello]] = []
        self.acks: list[Ack] = []
        self.invalid_frames: list[bytes] = []

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
        *frames, self._partial_frame = (self._partial_frame + os.read(self._fd, 1 << 16)).split(b"\0")
        for frame in filter(None, frames):
            try:
                self._store(unseal(frame))
            except ProtocolError:
                self.invalid_frames.append(frame)

    def _store(self, packet: bytes) -> None:
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
            assert time.monotonic() < deadline, "the board did not send what the test waits for"
            self.read()

    def next_samples(self, count: int) -> list[SampleMessage]:
        """Wait for the next ``count`` samples. Return them."""
        begin = len(self.samples)
        self.until(lambda: len(self.samples) >= begin + count)
        return self.samples[begin : begin + count]

    def next_hello(self) -> Hello:
        """Wait for the next hello. Return it."""
        begin = len(self.hellos)
        self.until(lambda: len(self.hellos) > begin)
        return self.hellos[begin][1]

    def send_command(self, command: bytes) -> Ack:
        """Send a command. Wait for its acknowledgment and return it."""
        begin = len(self.acks)
        self.send(command)
        self.until(lambda: len(self.acks) > begin)
        return self.acks[begin]
