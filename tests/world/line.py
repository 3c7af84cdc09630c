"""Simulated boards, their serial ports, and cables that corrupt and delay bytes.

The service opens a port with pyserial. Here pyserial returns one end of a pair of sockets; the service's other code is unchanged.
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
"""Number of bandgap readings whose sum the hello reports."""
NOISE_STEPS = 0.5
"""Noise of one conversion [steps]. A window has thousands of conversions, so that its mean has less noise."""
MIN_DELAY_S = 0.001
"""Minimum delay of a write on USB [s]."""
MAX_DELAY_S = 0.004
"""Maximum delay of a read or a write on USB [s]."""
BOOTLOADER_S = 0.2
"""Time from a reset by opening the port to the board's first message [s]."""
SPLIT_PROBABILITY = 0.2
"""Probability that bytes arrive in two reads."""
DECLARED_DIVIDER = 1.0
"""Ratio of the voltage divider that each board reports. The true ratio of the other pack's board differs from it."""
ARDUINO_USB_ID = 0x2341, 0x0043
"""Vendor and product id of an Arduino Uno."""


class Board:
    """Board that sends samples in the firmware's protocol or as lines of text.

    Args:
        serial_number: Serial number of the board.
        parts: True values of its parts.
        dice: Generator of the noise.
        text: True to print lines of text.
        first_rate_hz: Sample rate after a reset [Hz].
    """

    def __init__(
        self, serial_number: int, parts: BoardParts, dice: random.Random, *, text: bool, first_rate_hz: int
    ) -> None:
        self.serial_number, self._parts, self._dice, self.text = serial_number, parts, dice, text
        self._first_rate_hz = first_rate_hz
        self._buffer = b""
        self.stamp_errors_us = deque[int]()
        """Errors of the timestamps of the next samples [us]."""
        self._boot_id = dice.randrange(1 << 16)
        self.reset(ResetCause.POWER_ON)

    def reset(self, cause: ResetCause = ResetCause.EXTERNAL) -> bytes:
        """Reset the board; return its hello."""
        self._boot_id = (self._boot_id + 1) % (1 << 16)
        self._cause, self._sequence, self._board_ns, self._ntc_next, self._buffer = cause, 0, 0, False, b""
        self.stamp_errors_us.clear()
        self._window_ns = 0
        self._set_rate(self._first_rate_hz)
        return b"" if self.text else self._hello().encode()

    @property
    def period_s(self) -> float:
        """Sample period [s]."""
        return self._period_ns * 1e-9

    def begin_window(self) -> None:
        """Begin a window. The world calls this after each window, also if the board was reset meanwhile."""
        self._window_ns = self._period_ns

    @property
    def has_measured(self) -> bool:
        """True if the board was not reset since ``begin_window``, so that a sample is ready."""
        return self._window_ns > 0

    def step_clock(self, step_s: float) -> None:
        """Step the board's clock by ``step_s``, until the next reset."""
        self._board_ns += round(step_s * 1e9)

    def sample(self, reading: Reading) -> bytes:
        """Return the bytes of a sample with ``reading`` at the sensors."""
        self._board_ns += self._window_ns
        parts, count = self._parts, self._count
        voltage_sum = self._sum_conversions(reading.voltage_v / parts.divider / parts.supply_v, count)
        current_sum = self._sum_conversions(parts.current_zero + reading.current_a * parts.fraction_per_ampere, count)
        if self.text:
            volts = voltage_sum / count / FULL_SCALE * parts.supply_v * parts.divider
            amperes = (current_sum / count / FULL_SCALE - parts.current_zero) / parts.fraction_per_ampere
            return b"%.4f,%.4f,%.1f\r\n" % (volts, amperes, reading.temperature_c)
        aux_fraction = self._ntc_fraction(reading.temperature_c) if self._ntc_next else self._bandgap_fraction()
        status = BoardStatus.AUX_IS_NTC * self._ntc_next | (self._cause << 4)  # the upper half holds the reset cause
        self._ntc_next = not self._ntc_next
        stamp_error_us = self.stamp_errors_us.popleft() if self.stamp_errors_us else 0
        board_us = (self._board_ns // 1000 + stamp_error_us) % MODULUS
        aux_sum, aux_count = self._sum_conversions(aux_fraction, self._aux_count), self._aux_count
        message = SampleMessage(
            self._sequence, board_us, voltage_sum, current_sum, count, aux_sum, aux_count, int(status)
        )
        self._sequence = (self._sequence + 1) % MODULUS
        return message.encode()

    def receive(self, data: bytes) -> bytes:
        """Process bytes of the host; return the response."""
        *frames, self._buffer = (self._buffer + data).split(DELIMITER)
        responses = b""
        for frame in frames:
            with contextlib.suppress(ProtocolError):
                if frame and not self.text:
                    responses += self._execute(unseal(frame))
        return responses

    def _execute(self, packet: bytes) -> bytes:
        version, command, body = packet[0], packet[1], packet[2:]
        if version != PROTOCOL_VERSION:
            return Ack(command, AckResult.OTHER_VERSION, PROTOCOL_VERSION).encode()
        if command == MessageType.COMMAND_HELLO:
            return self._hello().encode()
        if command == MessageType.COMMAND_RESTART:
            return Ack(command, AckResult.OK, 0).encode() + self.reset(ResetCause.WATCHDOG)
        if command == MessageType.COMMAND_SET_RATE and len(body) == 2:
            (rate_hz,) = struct.unpack("<H", body)
            if rate_hz not in RATE_HZ:
                return Ack(command, AckResult.BAD_VALUE, self._period_ns).encode()
            self._set_rate(rate_hz)
            return Ack(command, AckResult.OK, self._period_ns).encode()
        return Ack(command, AckResult.UNKNOWN_COMMAND, 0).encode()

    def _set_rate(self, rate_hz: int) -> None:
        self._rate_hz = rate_hz
        self._count, self._period_ns = compute_window(rate_hz)
        self._aux_count = compute_aux_count(rate_hz)

    def _sum_conversions(self, fraction: float, count: int) -> int:
        """Return the noisy sum of ``count`` conversions of an input at ``fraction`` of the reference voltage."""
        steps = fraction * FULL_SCALE * count + self._dice.gauss(0.0, NOISE_STEPS * math.sqrt(count))
        return min(max(round(steps), 0), (FULL_SCALE - 1) * count)

    def _bandgap_fraction(self) -> float:
        return self._parts.bandgap_v / self._parts.supply_v

    def _ntc_fraction(self, temperature_c: float) -> float:
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
            board_us=self._board_ns // 1000 % MODULUS,
            rate_hz=self._rate_hz,
            period_ns=self._period_ns,
            adc_bits=10,
            channels=Channels.NTC | Channels.CURRENT_RATIOMETRIC * parts.ratiometric,
            divider_ppm=round(DECLARED_DIVIDER * 1e6),
            current_uv_per_a=round(parts.volts_per_ampere * 1e6),
            current_zero_ppm=round(parts.current_zero * 1e6),
            bandgap_uv=round(parts.bandgap_v * 1e6),
            bandgap_sum=round(self._bandgap_fraction() * FULL_SCALE * BANDGAP_READINGS),
            bandgap_count=BANDGAP_READINGS,
            ntc_series_ohm=parts.ntc_series_ohm,
            ntc_r25_ohm=parts.ntc_r25_ohm,
            ntc_beta_k=parts.ntc_beta_k,
        )


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
class OpenPort:
    """Port opened by the service: a pair of connected sockets."""

    service_end: socket.socket
    board_end: socket.socket
    last_arrival_s: float = 0.0
    """Arrival of the last bytes sent to the service [s]."""


class Cable:
    """Serial ports of the machine, and the board at one of them.

    Args:
        folder: Folder with a file for each port.
        timeline: Timeline of the world.
        dice: Generator of noise and delays.
        on_readable: Called with a descriptor that has bytes.
    """

    def __init__(
        self, folder: Path, timeline: Timeline, dice: random.Random, on_readable: Callable[[int], None]
    ) -> None:
        self.folder, self._timeline, self._dice, self._on_readable = folder, timeline, dice, on_readable
        folder.mkdir(parents=True)
        self.noise = Noise()
        self.board: Board | None = None
        self.port: Path | None = None
        self.open_port: OpenPort | None = None
        """Open port of the running process."""
        self.opened_ports: list[OpenPort] = []
        """All ports that the running process has opened, including closed ones."""
        self.resets_when_opened = True
        """True if opening the port resets the board, as an Arduino's DTR line does."""
        self.on_delivered: Callable[[bytes], None] = lambda _: None
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
        if self.open_port is not None:
            open_port, self.open_port = self.open_port, None
            open_port.board_end.close()
            self._notify_reader(open_port.service_end)

    def close_all(self) -> None:
        """Close all ports of an ended process."""
        for open_port in self.opened_ports:
            open_port.service_end.close()
            open_port.board_end.close()
        self.opened_ports, self.open_port = [], None

    def send(self, data: bytes) -> None:
        """Send bytes of the board; they arrive a little later, with the cable's noise."""
        open_port = self.open_port
        if open_port is None or not data or self.noise.mute:
            return
        data = self._with_noise(data)
        chunks = [data]
        if self._dice.random() < SPLIT_PROBABILITY:
            cut = self._dice.randint(0, len(data))
            chunks = [data[:cut], data[cut:]]
        for chunk in chunks:
            open_port.last_arrival_s = max(open_port.last_arrival_s, self._timeline.now_s) + self._dice.uniform(
                0.0, MAX_DELAY_S
            )
            self._timeline.at(open_port.last_arrival_s, lambda chunk=chunk: self._deliver(open_port, chunk))

    def open(self, path: str, *_: Any, **__: Any) -> "VirtualPort":
        """Replacement of pyserial's ``Serial``.

        Raises:
            SerialException: The port does not exist or is open.
        """
        if self.port is None or str(self.port) != os.path.realpath(path):
            raise serial.SerialException(2, f"could not open port {path}")
        if self.open_port is not None:
            raise serial.SerialException(11, f"could not lock port {path}")
        service_end, board_end = socket.socketpair()
        service_end.setblocking(False)
        board_end.setblocking(False)
        self.open_port = OpenPort(service_end, board_end)
        self.opened_ports.append(self.open_port)
        if self.board is not None and self.resets_when_opened:
            board = self.board
            hello = board.reset()
            self._timeline.after(BOOTLOADER_S, lambda: self.send(hello))
        return VirtualPort(self, self.open_port)

    def ports(self, *_: Any) -> list[ListPortInfo]:
        """Replacement of pyserial's ``comports``."""
        if self.port is None:
            return []
        info = ListPortInfo(str(self.port), skip_link_detection=True)
        info.vid, info.pid = ARDUINO_USB_ID
        info.serial_number = f"usb{self.board.serial_number:x}" if self.board else None
        return [info]

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace pyserial's ports."""
        original = serial.Serial, list_ports.comports
        serial.Serial, list_ports.comports = self.open, self.ports
        try:
            yield
        finally:
            serial.Serial, list_ports.comports = original

    def receive_soon(self, open_port: OpenPort) -> None:
        """Schedule reading the bytes that the service sends."""
        self._timeline.after(self._dice.uniform(MIN_DELAY_S, MAX_DELAY_S), lambda: self._receive(open_port))

    def close(self, open_port: OpenPort) -> None:
        """Close the port at the service's end."""
        open_port.service_end.close()
        if self.open_port is open_port:
            open_port.board_end.close()
            self.open_port = None

    def _receive(self, open_port: OpenPort) -> None:
        if self.open_port is not open_port or self.board is None:
            return
        with contextlib.suppress(BlockingIOError, OSError):
            data = open_port.board_end.recv(4096)
            if not self.noise.mute:
                self.send(self.board.receive(self._with_noise(data)))

    def _deliver(self, open_port: OpenPort, data: bytes) -> None:
        if self.open_port is not open_port or not data:
            return
        with contextlib.suppress(BlockingIOError, OSError):  # bytes are lost if the process does not read
            sent = open_port.board_end.send(data)
            self.on_delivered(data[:sent])
            self._notify_reader(open_port.service_end)

    def _notify_reader(self, service_end: socket.socket) -> None:
        if service_end.fileno() >= 0:
            self._on_readable(service_end.fileno())

    def _with_noise(self, data: bytes) -> bytes:
        flip, lose = self.noise.flip, self.noise.lose
        if not flip and not lose:
            return data
        draw = self._dice.random
        flipped = (byte ^ (1 << self._dice.randrange(8)) if draw() < flip else byte for byte in data)
        return bytes(byte for byte in flipped if draw() >= lose)


class VirtualPort:
    """Open port as pyserial presents it to the service."""

    def __init__(self, cable: Cable, open_port: OpenPort) -> None:
        self._cable, self._open_port = cable, open_port

    def fileno(self) -> int:
        self._cable.receive_soon(self._open_port)  # the service calls this before each write
        return self._open_port.service_end.fileno()

    def close(self) -> None:
        self._cable.close(self._open_port)
