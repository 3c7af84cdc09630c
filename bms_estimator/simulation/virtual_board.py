"""Simulated sensor board with the firmware's protocol on a pseudo-terminal, and optional faults."""

import asyncio
import contextlib
import itertools
import math
import os
import random
import select
import struct
import tty
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from typing import Literal, Self

from bms_estimator.protocols.firmware.messages import (
    DELIMITER,
    MAX_BANDGAP_V,
    MAX_DIVIDER,
    MAX_SILENT_S,
    MAX_VOLTS_PER_AMPERE,
    MIN_BANDGAP_V,
    MIN_DIVIDER,
    MIN_VOLTS_PER_AMPERE,
    MODULUS,
    PROTOCOL_VERSION,
    RATE_HZ,
    RELAY_HIGH,
    RELAY_KEEP,
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
from bms_estimator.simulation.virtual_adc import (
    FULL_SCALE,
    BoardParts,
    Reading,
    VirtualConverter,
    compute_aux_count,
    compute_window,
)

Signal = Callable[[float], Reading] | Iterable[Reading]
"""Readings as a function of time [s], or one reading for each sample. The board stops after the last one."""

FIRMWARE = (0, 2, 0)
"""Version of the firmware that the board reports."""
RATE_HZ_AT_RESET = 100
"""Sample rate after a reset [Hz]."""
_MAX_UNSENT_BYTES = 2048
"""Maximum number of unsent bytes. Further samples are dropped, as on a board whose host does not read."""
_MIN_SLEEP_S = 0.002
"""Minimum sleep [s]. Samples that are due within this time are sent together, as on USB."""
_DRAIN_TIMEOUT_S = 1.0
"""Maximum time that the board waits for the host to read the last bytes before ``run`` returns [s]."""
_HOST_POLL_S = 0.01
"""Interval of the check for a host that opens the line [s]."""
_BOOT_S = 0.2
"""Delay from the opening of the port to the first sample [s]. Opening resets a board, and the host discards old
bytes."""
_MAX_SAMPLES_AT_ONCE = 256
"""Maximum number of due samples that are sent before the event loop runs again."""
_BOOT_READINGS = 256
"""Number of bandgap conversions at a reset."""
_GARBAGE_BYTES = 40
"""Number of random bytes before a frame with garbage."""
_MAX_ZERO_OFFSET = 0.1
"""Maximum deviation of the sensor's output without current from half of the supply, as a fraction of the supply."""


def _millionths(minimum: float, maximum: float) -> range:
    return range(round(minimum * 1e6), round(maximum * 1e6) + 1)


_VALID_VALUES = {
    MessageType.COMMAND_SET_SERIAL: range(MODULUS),
    MessageType.COMMAND_SET_BANDGAP: _millionths(MIN_BANDGAP_V, MAX_BANDGAP_V),
    MessageType.COMMAND_SET_DIVIDER: _millionths(MIN_DIVIDER, MAX_DIVIDER),
    MessageType.COMMAND_SET_CURRENT_SLOPE: _millionths(MIN_VOLTS_PER_AMPERE, MAX_VOLTS_PER_AMPERE),
    MessageType.COMMAND_SET_RATIOMETRIC: range(2),
}
"""Valid values of the commands that store a number."""


class BoardFault(Enum):
    """Fault of a sample's frame; the value of the enumeration describes the frame."""

    DROP = "never sent"
    CORRUPT = "one byte changed"
    TRUNCATE = "its second half missing"
    DUPLICATE = "sent twice"
    SWAP = "sent after the next one"
    NEWER_VERSION = "of the next protocol version"
    GARBAGE = "noise before it"


class VirtualBoard:
    """Simulated board on a pseudo-terminal. Open it as a context manager, then ``run`` it.

    Args:
        signal: Readings of the simulated pack.
        rate_hz: Samples per second until the host requests another rate.
        mode: ``text`` prints ``voltage,current,temperature`` lines and takes no commands.
        speed: Speed relative to real time; ``math.inf``: as fast as the host reads.
        parts: Parts of the board as built.
        noise_lsb: Noise of its converter [steps].
        serial: Serial number.
        clock_us: Value of the board's clock after each reset [us].
        seed: Seed of noise and garbage.
    """

    def __init__(
        self,
        signal: Signal,
        *,
        rate_hz: int = RATE_HZ_AT_RESET,
        mode: Literal["binary", "text"] = "binary",
        speed: float = 1.0,
        parts: BoardParts | None = None,
        noise_lsb: float = 0.5,
        serial: int = 1,
        clock_us: int = 0,
        seed: int = 0,
    ) -> None:
        self._mode = mode
        self.speed = speed
        """Speed relative to real time; a change applies from the next ``run``."""
        self._readings = self._readings_from(signal) if callable(signal) else iter(signal)
        self._reading = Reading(0.0, 0.0)
        self._converter = VirtualConverter(parts or BoardParts(), noise_lsb, seed)
        self._reset_clock_us = clock_us
        parts = self._converter.parts
        self._zero_ppm = round(parts.current_zero * 1e6)
        self._stored: dict[int, int] = {
            MessageType.COMMAND_SET_SERIAL: serial,
            MessageType.COMMAND_SET_BANDGAP: round(parts.bandgap_v * 1e6),
            MessageType.COMMAND_SET_DIVIDER: round(parts.divider * 1e6),
            MessageType.COMMAND_SET_CURRENT_SLOPE: round(parts.volts_per_ampere * 1e6),
            MessageType.COMMAND_SET_RATIOMETRIC: int(parts.ratiometric),
        }
        self._random = random.Random(seed)
        self._boot_id = self._random.randrange(1 << 16)
        self._reset_rate_hz = rate_hz
        self._faults: deque[BoardFault] = deque()
        self._delayed_frame = b""
        self._inbox = b""
        self._unsent = bytearray()
        self._drained = asyncio.Event()
        self._board_fd = self._host_fd = -1
        self._loop: asyncio.AbstractEventLoop | None = None
        self.path = ""
        """Path of the pseudo-terminal."""
        self.time_s = 0.0
        """Time of the pack model at the end of the last sample [s]; it continues across resets."""
        self.samples = 0
        """Number of samples since the board was created."""
        self.relay_high = False
        """Level of the relay pin."""
        self._boot(ResetCause.POWER_ON)

    def __enter__(self) -> Self:
        """Open the pseudo-terminal."""
        self._board_fd, self._host_fd = os.openpty()
        tty.setraw(self._host_fd)
        os.set_blocking(self._board_fd, False)
        self.path = os.ttyname(self._host_fd)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the pseudo-terminal, as if the board were unplugged."""
        self._stop_watching()  # before closing: the loop would take a reused descriptor number for the old one
        for descriptor in (self._board_fd, self._host_fd):
            if descriptor >= 0:
                os.close(descriptor)
        self._board_fd = self._host_fd = -1

    async def run(self, seconds: float = math.inf) -> None:
        """Sample and send for ``seconds`` of the board's time, or until the signal ends."""
        self._loop = loop = asyncio.get_running_loop()
        loop.add_reader(self._board_fd, self._receive)
        self._receive()  # commands that arrived before; a short run may end before the loop calls the reader
        try:
            await self._sample_until(self.time_s + seconds, loop)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if math.isinf(self.speed) else _DRAIN_TIMEOUT_S):
                    await self._drain()
        finally:
            self._stop_watching()

    def _stop_watching(self) -> None:
        """Remove the line from the event loop, if the board runs."""
        if self._loop is not None and self._board_fd >= 0:
            self._loop.remove_reader(self._board_fd)
            self._loop.remove_writer(self._board_fd)
        self._loop = None

    async def run_for_host(self) -> None:
        """Wait until a host opens the line, then ``run``. Earlier samples would be lost."""
        os.close(self._host_fd)  # the poll reports a hangup while no process has the line open
        self._host_fd, poller = -1, select.poll()
        poller.register(self._board_fd, 0)
        while poller.poll(0):  # noqa: ASYNC110 - the system does not report when a line is opened
            await asyncio.sleep(_HOST_POLL_S)
        self._host_fd = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._host_fd)
        await asyncio.sleep(_BOOT_S)
        self.send(self._hello().encode())
        await self.run()

    async def _drain(self) -> None:
        """Wait until all bytes are written to the line."""
        while self._unsent:
            self._drained.clear()
            await self._drained.wait()

    def inject(self, fault: BoardFault, frames: int = 1) -> None:
        """Apply ``fault`` to the next ``frames`` frames that have no fault yet."""
        self._faults.extend(itertools.repeat(fault, frames))

    def reset(self, cause: ResetCause = ResetCause.EXTERNAL) -> None:
        """Reset the board: sequence number, clock and rate restart, and a hello is sent."""
        self._boot(cause)

    def send(self, data: bytes) -> None:
        """Write arbitrary bytes to the line."""
        self._unsent += data
        self._flush()

    def _readings_from(self, signal: Callable[[float], Reading]) -> Iterator[Reading]:
        while True:
            yield signal(self.time_s)

    def _boot(self, cause: ResetCause) -> None:
        self._reset_cause = cause
        self.relay_high, self._relay_fallback = False, RELAY_KEEP
        self._relay_delay_s = self._relay_word = 0
        self._relay_command_s = 0.0
        self._boot_id = (self._boot_id + 1) % (1 << 16)
        self._sequence, self._clock_ns, self._overrun, self._aux_is_ntc = 0, self._reset_clock_us * 1000, False, False
        self._set_rate(self._reset_rate_hz)
        self._boot_bandgap = self._converter.bandgap(_BOOT_READINGS)
        if self._mode == "binary":
            self.send(self._hello().encode())

    def _set_rate(self, rate_hz: int) -> None:
        self._rate_hz = rate_hz
        self._pair_count, self._period_ns = compute_window(rate_hz)
        self._aux_count = compute_aux_count(rate_hz)

    async def _sample_until(self, end_s: float, loop: asyncio.AbstractEventLoop) -> None:
        start_s = loop.time() - self.time_s / self.speed  # loop time at which the pack's time is 0
        while self.time_s < end_s:
            for _ in range(_MAX_SAMPLES_AT_ONCE):
                due_s = start_s + (self.time_s + self._period_ns * 1e-9) / self.speed
                if due_s > loop.time() or self.time_s >= end_s:
                    break
                if not self._take_sample():
                    return
            self._flush()
            if math.isinf(self.speed) and self._unsent:
                await self._drain()  # the host's reads set the pace
            else:
                await asyncio.sleep(max(due_s - loop.time(), 0.0 if math.isinf(self.speed) else _MIN_SLEEP_S))

    def _take_sample(self) -> bool:
        """Send one sample. Return False if the signal has ended."""
        self.time_s += self._period_ns * 1e-9
        reading = next(self._readings, None)
        if reading is None:
            return False
        self._reading = reading
        self._clock_ns += self._period_ns
        self.samples += 1
        self._apply_relay_fallback()
        message = self._sample_message(reading)
        self._sequence = (self._sequence + 1) % MODULUS
        if len(self._unsent) > _MAX_UNSENT_BYTES and not math.isinf(self.speed):
            self._overrun = True
            return True
        self._overrun = False
        self._unsent += self._text_line(message, reading) if self._mode == "text" else self._frame_with_fault(message)
        return True

    def _sample_message(self, reading: Reading) -> SampleMessage:
        sums = self._converter.window(reading, self._pair_count)
        status = BoardStatus.AUX_IS_NTC * self._aux_is_ntc + (self._reset_cause << 4)  # the upper half is the cause
        status |= BoardStatus.VOLTAGE_SATURATED * sums.voltage_saturated
        status |= BoardStatus.CURRENT_SATURATED * sums.current_saturated
        status |= BoardStatus.OVERRUN * self._overrun
        n = self._aux_count
        aux = self._converter.ntc(reading.temperature_c, n) if self._aux_is_ntc else self._converter.bandgap(n)
        self._aux_is_ntc = not self._aux_is_ntc  # NTC and bandgap alternate
        board_us = self._clock_ns // 1000 % MODULUS
        return SampleMessage(self._sequence, board_us, sums.voltage, sums.current, sums.pairs, aux, n, int(status))

    def _text_line(self, message: SampleMessage, reading: Reading) -> bytes:
        """Return the line that a simple Arduino sketch would print."""
        parts = self._converter.parts
        volts_per_step = parts.supply_v / FULL_SCALE / message.count
        voltage_v = message.voltage_sum * volts_per_step * parts.divider
        fraction = message.current_sum / message.count / FULL_SCALE
        current_a = (fraction - parts.current_zero) / parts.fraction_per_ampere
        if math.isnan(reading.temperature_c):
            return b"%.3f,%.3f\r\n" % (voltage_v, current_a)
        return b"%.3f,%.3f,%.1f\r\n" % (voltage_v, current_a, reading.temperature_c)

    def _frame_with_fault(self, message: SampleMessage) -> bytes:
        """Return the bytes of a sample, changed by the next fault if there is one."""
        frame, delayed, self._delayed_frame = message.encode(), self._delayed_frame, b""
        if not self._faults:
            return frame + delayed
        match self._faults.popleft():
            case BoardFault.DROP:
                frame = b""
            case BoardFault.CORRUPT:
                at = self._random.randrange(len(frame) - 1)
                changed = frame[at] % 255 + 1  # another byte, but no delimiter
                frame = frame[:at] + bytes((changed,)) + frame[at + 1 :]
            case BoardFault.TRUNCATE:
                frame = frame[: len(frame) // 2] + DELIMITER
            case BoardFault.DUPLICATE:
                frame *= 2
            case BoardFault.SWAP:
                frame, self._delayed_frame = b"", frame
            case BoardFault.NEWER_VERSION:
                frame = message.encode(PROTOCOL_VERSION + 1)
            case BoardFault.GARBAGE:
                frame = self._random.randbytes(_GARBAGE_BYTES) + DELIMITER + frame
        return frame + delayed

    def _hello(self) -> Hello:
        parts = self._converter.parts
        return Hello(
            *FIRMWARE,
            reset_cause=self._reset_cause,
            boot_id=self._boot_id,
            serial=self._stored[MessageType.COMMAND_SET_SERIAL],
            sequence=self._sequence,
            board_us=self._clock_ns // 1000 % MODULUS,
            rate_hz=self._rate_hz,
            period_ns=self._period_ns,
            adc_bits=10,
            channels=Channels.NTC + Channels.CURRENT_RATIOMETRIC * self._stored[MessageType.COMMAND_SET_RATIOMETRIC],
            divider_ppm=self._stored[MessageType.COMMAND_SET_DIVIDER],
            current_uv_per_a=self._stored[MessageType.COMMAND_SET_CURRENT_SLOPE],
            current_zero_ppm=self._zero_ppm,
            bandgap_uv=self._stored[MessageType.COMMAND_SET_BANDGAP],
            bandgap_sum=self._boot_bandgap,
            bandgap_count=_BOOT_READINGS,
            ntc_series_ohm=parts.ntc_series_ohm,
            ntc_r25_ohm=parts.ntc_r25_ohm,
            ntc_beta_k=parts.ntc_beta_k,
        )

    def _receive(self) -> None:
        """Read from the host and handle complete commands."""
        with contextlib.suppress(BlockingIOError):
            self._inbox += os.read(self._board_fd, 4096)
        *frames, self._inbox = self._inbox.split(DELIMITER)
        if self._mode == "text":
            return
        for frame in frames:
            with contextlib.suppress(ProtocolError):  # no response: the host repeats the request
                self._handle_command(unseal(frame) if frame else b"")

    def _handle_command(self, packet: bytes) -> None:
        if not packet:
            return
        command, body = packet[1], packet[2:]
        if packet[0] != PROTOCOL_VERSION:
            self._send_ack(command, AckResult.OTHER_VERSION, PROTOCOL_VERSION)
        elif command == MessageType.COMMAND_HELLO:
            self.send(self._hello().encode())
        elif command == MessageType.COMMAND_RESTART:
            self._send_ack(command, AckResult.OK, 0)
            self.reset(ResetCause.WATCHDOG)
        elif command == MessageType.COMMAND_ZERO_CURRENT:
            self._zero_current()
        elif command == MessageType.COMMAND_SET_RATE and len(body) == 2:
            (rate_hz,) = struct.unpack("<H", body)
            if rate_hz in RATE_HZ:
                self._set_rate(rate_hz)
            self._send_ack(command, AckResult.OK if rate_hz in RATE_HZ else AckResult.BAD_VALUE, self._period_ns)
        elif command == MessageType.COMMAND_SET_RELAY and len(body) == 4:
            self._set_relay(*struct.unpack("<I", body))
        elif command in self._stored and len(body) == 4:
            self._store(MessageType(command), *struct.unpack("<I", body))
        else:
            self._send_ack(command, AckResult.UNKNOWN_COMMAND, 0)

    def _store(self, command: MessageType, value: int) -> None:
        """Store the number of a command if it is valid."""
        is_valid = value in _VALID_VALUES[command]
        if is_valid:
            self._stored[command] = value
        self._send_ack(command, AckResult.OK if is_valid else AckResult.BAD_VALUE, self._stored[command])

    def _set_relay(self, word: int) -> None:
        """Set the relay from the bits of ``relay_word``. A fallback level needs a delay."""
        fallback, silent_s = word >> 8 & 0xFF, word >> 16
        is_valid = (
            word & 0xFE == 0  # unused bits
            and fallback <= RELAY_HIGH
            and silent_s <= MAX_SILENT_S
            and (fallback == RELAY_KEEP or silent_s > 0)
        )
        if is_valid:
            self.relay_high, self._relay_fallback, self._relay_delay_s = bool(word & 1), fallback, silent_s
            self._relay_command_s = self.time_s
            self._relay_word = word
        self._send_ack(
            MessageType.COMMAND_SET_RELAY, AckResult.OK if is_valid else AckResult.BAD_VALUE, self._relay_word
        )

    def _apply_relay_fallback(self) -> None:
        """Set the relay to its fallback level after the delay without a relay command."""
        if self._relay_fallback != RELAY_KEEP and self.time_s - self._relay_command_s >= self._relay_delay_s:
            self.relay_high, self._relay_fallback = self._relay_fallback == RELAY_HIGH, RELAY_KEEP

    def _zero_current(self) -> None:
        count = compute_window(rate_hz=1)[0]  # the firmware also averages for a second
        zero = self._converter.window(self._reading, count).current / count / FULL_SCALE
        is_valid = abs(zero - 0.5) <= _MAX_ZERO_OFFSET
        self._zero_ppm = round(zero * 1e6) if is_valid else self._zero_ppm
        result = AckResult.OK if is_valid else AckResult.BAD_VALUE
        self._send_ack(MessageType.COMMAND_ZERO_CURRENT, result, self._zero_ppm)

    def _send_ack(self, command: int, result: AckResult, value: int) -> None:
        self.send(Ack(command, result, value).encode())

    def _flush(self) -> None:
        """Write as much as the pseudo-terminal accepts; register a writer for the rest."""
        if self._board_fd < 0:
            return
        with contextlib.suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: os.write(self._board_fd, self._unsent)]
        if self._unsent:
            asyncio.get_running_loop().add_writer(self._board_fd, self._flush)
        else:
            self._drained.set()
            with contextlib.suppress(RuntimeError):  # no event loop is running, so that there is no writer
                asyncio.get_running_loop().remove_writer(self._board_fd)
