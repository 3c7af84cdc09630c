"""Boards, the ports they are plugged into, and what the cable does to their bytes.

The service opens a port with pyserial, which here gives one end of a pair of sockets; all behind that is its own code.
"""

import contextlib
import math
import os
import random
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from bms_estimator.protocols.firmware.messages import (
    DELIMITER,
    MODULUS,
    PROTOCOL_VERSION,
    RATE_HZ,
    Ack,
    AckResult,
    BoardStatus,
    Channels,
    Hello,
    MessageType,
    ProtocolError,
    ResetCause,
    SampleMessage,
    unseal,
)
from bms_estimator.simulation.virtual_adc import FULL_SCALE, BoardParts, Reading, compute_aux_count, compute_window
from bms_estimator.simulation.virtual_board import FIRMWARE
from tests.world.loop import Timeline

BANDGAP_READINGS = 256
NOISE_STEPS = 0.5
"""Noise of one conversion [steps]. A window has thousands, so that their mean is more accurate."""
LATE_S = 0.004
"""Maximum delay of a read on USB [s]."""
ARDUINO = 0x2341, 0x0043


class Board:
    """A board that samples what it is shown, in the firmware's protocol or in lines of text.

    Args:
        serial_number: Its own.
        parts: As built.
        text: Prints lines.
        first_rate_hz: After a reset.
        dice: Of its noise.
    """

    def __init__(
        self, serial_number: int, parts: BoardParts, dice: random.Random, *, text: bool, first_rate_hz: int
    ) -> None:
        self.serial_number, self._parts, self._dice, self.text = serial_number, parts, dice, text
        self._first_rate_hz = first_rate_hz
        self._inbox = b""
        self.stamps_off_us = deque[int]()
        """Errors of the timestamps of the next samples [s]."""
        self._boot_id = dice.randrange(1 << 16)
        self.reset(ResetCause.POWER_ON)

    def reset(self, cause: ResetCause = ResetCause.EXTERNAL) -> bytes:
        """Reset the board; return its hello."""
        self._boot_id = (self._boot_id + 1) % (1 << 16)
        self._cause, self._sequence, self._ns, self._ntc_next, self._inbox = cause, 0, 0, False, b""
        self.stamps_off_us.clear()
        self._window_ns = 0
        self._set_rate(self._first_rate_hz)
        return b"" if self.text else self._hello().encode()

    @property
    def period_s(self) -> float:
        """Sample period [s]."""
        return self._period_ns * 1e-9

    def begin_window(self) -> None:
        """Begin a window, at times that neither a reset nor a change of rate shifts."""
        self._window_ns = self._period_ns

    @property
    def has_measured(self) -> bool:
        """True if a window has ended, without a reset meanwhile."""
        return self._window_ns > 0

    def step_clock(self, step_s: float) -> None:
        """Step the board's clock by ``step_s``, until the next reset."""
        self._ns += round(step_s * 1e9)

    def sample(self, reading: Reading) -> bytes:
        """Return the bytes of a sample with ``reading`` at the sensors."""
        self._ns += self._window_ns
        parts, count = self._parts, self._count
        voltage = self._sum(reading.voltage_v / parts.divider / parts.supply_v, count)
        current = self._sum(parts.current_zero + reading.current_a * parts.fraction_per_ampere, count)
        if self.text:
            volts = voltage / count / FULL_SCALE * parts.supply_v * parts.divider
            amperes = (current / count / FULL_SCALE - parts.current_zero) / parts.fraction_per_ampere
            return b"%.4f,%.4f,%.1f\r\n" % (volts, amperes, reading.temperature_c)
        aux = self._ntc(reading.temperature_c) if self._ntc_next else self._bandgap()
        status = BoardStatus.AUX_IS_NTC * self._ntc_next | (self._cause << 4)
        self._ntc_next = not self._ntc_next
        n = self._aux_count
        off_us = self.stamps_off_us.popleft() if self.stamps_off_us else 0
        board_us = (self._ns // 1000 + off_us) % MODULUS
        message = SampleMessage(self._sequence, board_us, voltage, current, count, self._sum(aux, n), n, int(status))
        self._sequence = (self._sequence + 1) % MODULUS
        return message.encode()

    def hear(self, data: bytes) -> bytes:
        """Process bytes of the host; return the response."""
        *frames, self._inbox = (self._inbox + data).split(DELIMITER)
        answers = b""
        for frame in frames:
            with contextlib.suppress(ProtocolError):
                if frame and not self.text:
                    answers += self._obey(unseal(frame))
        return answers

    def _obey(self, packet: bytes) -> bytes:
        kind, body = packet[1], packet[2:]
        if packet[0] != PROTOCOL_VERSION:
            return Ack(kind, AckResult.OTHER_VERSION, PROTOCOL_VERSION).encode()
        if kind == MessageType.COMMAND_HELLO:
            return self._hello().encode()
        if kind == MessageType.COMMAND_RESTART:
            return Ack(kind, AckResult.OK, 0).encode() + self.reset(ResetCause.WATCHDOG)
        if kind == MessageType.COMMAND_SET_RATE and len(body) == 2:
            (rate_hz,) = struct.unpack("<H", body)
            if rate_hz not in RATE_HZ:
                return Ack(kind, AckResult.BAD_VALUE, self._period_ns).encode()
            self._set_rate(rate_hz)
            return Ack(kind, AckResult.OK, self._period_ns).encode()
        return Ack(kind, AckResult.UNKNOWN_COMMAND, 0).encode()

    def _set_rate(self, rate_hz: int) -> None:
        self._rate_hz = rate_hz
        self._count, self._period_ns = compute_window(rate_hz)
        self._aux_count = compute_aux_count(rate_hz)

    def _sum(self, part: float, count: int) -> int:
        """Return the sum of ``count`` conversions of a fraction of the reference."""
        steps = part * FULL_SCALE * count + self._dice.gauss(0.0, NOISE_STEPS * math.sqrt(count))
        return min(max(round(steps), 0), (FULL_SCALE - 1) * count)

    def _bandgap(self) -> float:
        return self._parts.bandgap_v / self._parts.supply_v

    def _ntc(self, temperature_c: float) -> float:
        parts = self._parts
        r_ohm = parts.ntc_r25_ohm * math.exp(parts.ntc_beta_k * (1.0 / (temperature_c + 273.15) - 1.0 / 298.15))
        return r_ohm / (r_ohm + parts.ntc_series_ohm)

    def _hello(self) -> Hello:
        parts = self._parts
        return Hello(
            *FIRMWARE,
            reset_cause=self._cause,
            boot_id=self._boot_id,
            serial=self.serial_number,
            sequence=self._sequence,
            board_us=self._ns // 1000 % MODULUS,
            rate_hz=self._rate_hz,
            period_ns=self._period_ns,
            adc_bits=10,
            channels=Channels.NTC | Channels.CURRENT_RATIOMETRIC * parts.ratiometric,
            divider_ppm=round(DECLARED_DIVIDER * 1e6),
            current_uv_per_a=round(parts.volts_per_ampere * 1e6),
            current_zero_ppm=round(parts.current_zero * 1e6),
            bandgap_uv=round(parts.bandgap_v * 1e6),
            bandgap_sum=round(self._bandgap() * FULL_SCALE * BANDGAP_READINGS),
            bandgap_count=BANDGAP_READINGS,
            ntc_series_ohm=parts.ntc_series_ohm,
            ntc_r25_ohm=parts.ntc_r25_ohm,
            ntc_beta_k=parts.ntc_beta_k,
        )


DECLARED_DIVIDER = 1.0
"""Divider that each board reports; the other pack's board has a different one."""


@dataclass
class Noise:
    """Noise of the cable."""

    flip: float = 0.0
    """Probability that a byte is corrupted."""
    lose: float = 0.0
    """Probability that a byte is lost."""
    mute: bool = False
    """True if no byte passes."""


@dataclass
class Opening:
    """Port opened by the service, and the delivered bytes."""

    near: socket.socket
    far: socket.socket
    late_until_s: float = 0.0


class Cable:
    """The ports of the machine, and the board on one of them.

    Args:
        folder: Where the ports are files.
        timeline: The world's.
        dice: Noise and delays.
        readable: Told when a descriptor has bytes.
    """

    def __init__(self, folder: Path, timeline: Timeline, dice: random.Random, readable: Callable[[int], None]) -> None:
        self.folder, self._timeline, self._dice, self._readable = folder, timeline, dice, readable
        folder.mkdir(parents=True)
        self.noise = Noise()
        self.board: Board | None = None
        self.port: Path | None = None
        self.opening: Opening | None = None
        self.openings: list[Opening] = []
        """Open port of the present process."""
        self.resets_when_opened = True
        self.delivered: Callable[[bytes], None] = lambda _: None
        """Called with the bytes delivered to the service."""

    def plug(self, board: Board, name: str) -> None:
        """Plug a board in under a port name."""
        self.board, self.port = board, self.folder / name
        self.port.touch()

    def unplug(self) -> Board | None:
        """Unplug the board."""
        board, self.board = self.board, None
        if self.port is not None:
            self.port.unlink(missing_ok=True)
            self.port = None
        self.hang_up()
        return board

    def hang_up(self) -> None:
        """Close the port at its device end."""
        if self.opening is not None:
            opening, self.opening = self.opening, None
            opening.far.close()
            self._readable_soon(opening.near)

    def forget(self) -> None:
        """Drop the port of an ended process."""
        for opening in self.openings:
            opening.near.close()
            opening.far.close()
        self.openings, self.opening = [], None

    def send(self, data: bytes) -> None:
        """Send bytes of the board; they arrive a little later, with the cable's noise."""
        opening = self.opening
        if opening is None or not data or self.noise.mute:
            return
        data = self._marred(data)
        parts = [data]
        if self._dice.random() < 0.2:
            cut = self._dice.randint(0, len(data))
            parts = [data[:cut], data[cut:]]
        for part in parts:
            opening.late_until_s = max(opening.late_until_s, self._timeline.now_s) + self._dice.uniform(0.0, LATE_S)
            self._timeline.at(opening.late_until_s, lambda part=part: self._deliver(opening, part))

    def open(self, path: str, *_: Any, **__: Any) -> "VirtualPort":
        """As pyserial's ``Serial``.

        Raises:
            SerialException: The port is not there, or is open.
        """
        if self.port is None or str(self.port) != os.path.realpath(path):
            raise serial.SerialException(2, f"could not open port {path}")
        if self.opening is not None:
            raise serial.SerialException(11, f"could not lock port {path}")
        near, far = socket.socketpair()
        near.setblocking(False)
        far.setblocking(False)
        self.opening = Opening(near, far)
        self.openings.append(self.opening)
        if self.board is not None and self.resets_when_opened:
            board = self.board
            hello = board.reset()
            self._timeline.after(0.2, lambda: self.send(hello))
        return VirtualPort(self, self.opening)

    def ports(self, *_: Any) -> list[ListPortInfo]:
        """Replacement of pyserial's ``comports``."""
        if self.port is None:
            return []
        info = ListPortInfo(str(self.port), skip_link_detection=True)
        info.vid, info.pid = ARDUINO
        info.serial_number = f"usb{self.board.serial_number:x}" if self.board else None
        return [info]

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace pyserial's ports."""
        kept = serial.Serial, list_ports.comports
        serial.Serial, list_ports.comports = self.open, self.ports
        try:
            yield
        finally:
            serial.Serial, list_ports.comports = kept

    def hear_soon(self, opening: Opening) -> None:
        """Schedule reading the bytes that the service sends."""
        self._timeline.after(self._dice.uniform(0.001, LATE_S), lambda: self._hear(opening))

    def close(self, opening: Opening) -> None:
        """Close the port at the service's end."""
        opening.near.close()
        if self.opening is opening:
            opening.far.close()
            self.opening = None

    def _hear(self, opening: Opening) -> None:
        if self.opening is not opening or self.board is None:
            return
        with contextlib.suppress(BlockingIOError, OSError):
            data = opening.far.recv(4096)
            if not self.noise.mute:
                self.send(self.board.hear(self._marred(data)))

    def _deliver(self, opening: Opening, data: bytes) -> None:
        if self.opening is not opening or not data:
            return
        with contextlib.suppress(BlockingIOError, OSError):  # a process that does not read
            sent = opening.far.send(data)
            self.delivered(data[:sent])
            self._readable_soon(opening.near)

    def _readable_soon(self, near: socket.socket) -> None:
        if near.fileno() >= 0:
            self._readable(near.fileno())

    def _marred(self, data: bytes) -> bytes:
        flip, lose = self.noise.flip, self.noise.lose
        if not flip and not lose:
            return data
        random_ = self._dice.random
        kept = (byte ^ (1 << self._dice.randrange(8)) if random_() < flip else byte for byte in data)
        return bytes(byte for byte in kept if random_() >= lose)


class VirtualPort:
    """Open port as pyserial presents it to the service."""

    def __init__(self, cable: Cable, opening: Opening) -> None:
        self._cable, self._opening = cable, opening

    def fileno(self) -> int:
        self._cable.hear_soon(self._opening)  # called before each write
        return self._opening.near.fileno()

    def close(self) -> None:
        self._cable.close(self._opening)
