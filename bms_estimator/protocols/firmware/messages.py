"""Codec of single messages of the serial line (firmware/PROTOCOL.md): commands, hello, acknowledgment, sample.

The kernels of ``framing`` decode streams of samples. This codec is for rare messages, the virtual board and tests.
"""

import binascii
import math
import struct
from dataclasses import dataclass, fields
from enum import IntEnum, IntFlag
from typing import ClassVar, Self

from cobs import cobs

from bms_estimator.protocols.base.relay import Relay

PROTOCOL_VERSION = 1
BAUD = 500_000
"""Baud rate of the firmware [1/s]."""
RATE_HZ = range(1, 1001)
"""Valid sample rates [Hz]."""
MIN_BANDGAP_V, MAX_BANDGAP_V = 1.0, 1.2
"""Range of the internal reference of an ATmega328P according to its data sheet [V]."""
MIN_DIVIDER, MAX_DIVIDER = 1.0, 100.0
"""Range of the voltage divider's ratio."""
MIN_VOLTS_PER_AMPERE, MAX_VOLTS_PER_AMPERE = 0.001, 2.0
"""Range of the slope of the current sensor [V/A]."""
DELIMITER = b"\0"
MODULUS = 1 << 32
"""Modulus of sequence numbers and microseconds."""


class MessageType(IntEnum):
    """Message type, the second byte of a packet."""

    SAMPLE = 0x01
    HELLO = 0x02
    ACK = 0x03
    COMMAND_HELLO = 0x10
    COMMAND_SET_RATE = 0x11
    COMMAND_ZERO_CURRENT = 0x12
    COMMAND_RESTART = 0x13
    COMMAND_SET_SERIAL = 0x14
    COMMAND_SET_BANDGAP = 0x15
    COMMAND_SET_DIVIDER = 0x16
    COMMAND_SET_CURRENT_SLOPE = 0x17
    COMMAND_SET_RATIOMETRIC = 0x18
    COMMAND_SET_RELAY = 0x19


class AckResult(IntEnum):
    """Result of a command."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_VALUE = 2
    BUSY = 3
    OTHER_VERSION = 4


class BoardStatus(IntFlag):
    """Status bits of a sample on the line; the upper half is ``ResetCause`` shifted by four."""

    VOLTAGE_SATURATED = 0x01
    CURRENT_SATURATED = 0x02
    OVERRUN = 0x04
    AUX_IS_NTC = 0x08


class Channels(IntFlag):
    """Hardware options of a board in its hello."""

    NTC = 0x01
    CURRENT_RATIOMETRIC = 0x02


class ResetCause(IntFlag):
    """MCUSR of the ATmega328P after its last reset."""

    POWER_ON = 1
    EXTERNAL = 2
    BROWN_OUT = 4
    WATCHDOG = 8


class ProtocolError(ValueError):
    """Error of bytes that are not a message of this protocol."""


def seal(packet: bytes) -> bytes:
    """Return the COBS frame of a packet with its CRC and the delimiter."""
    return bytes(cobs.encode(packet + struct.pack("<H", binascii.crc_hqx(packet, 0xFFFF)))) + DELIMITER


def unseal(frame: bytes) -> bytes:
    """Return the packet of a frame, without its CRC; the delimiter is optional.

    Raises:
        ProtocolError: The frame is not COBS, is too short, or has a wrong CRC.
    """
    try:
        packet = bytes(cobs.decode(frame.removesuffix(DELIMITER)))
    except cobs.DecodeError as error:
        raise ProtocolError(f"not COBS: {error}") from None
    if len(packet) < 4:  # version, type and CRC
        raise ProtocolError(f"a packet of {len(packet)} bytes")
    if binascii.crc_hqx(packet[:-2], 0xFFFF) != int.from_bytes(packet[-2:], "little"):
        raise ProtocolError("wrong CRC")
    return packet[:-2]


def command(message_type: MessageType, body: bytes = b"") -> bytes:
    """Return the frame of a command."""
    return seal(bytes((PROTOCOL_VERSION, message_type)) + body)


def hello_command() -> bytes:
    """Build the command that requests the hello."""
    return command(MessageType.COMMAND_HELLO)


def set_rate_command(rate_hz: int) -> bytes:
    """Build the command that sets the sample rate.

    Raises:
        ValueError: The rate is outside 1..1000 Hz.
    """
    if rate_hz not in RATE_HZ:
        raise ValueError(f"{rate_hz} samples per second: must be within 1..1000")
    return command(MessageType.COMMAND_SET_RATE, struct.pack("<H", rate_hz))


def zero_current_command() -> bytes:
    """Build the command that permanently stores the present current as zero."""
    return command(MessageType.COMMAND_ZERO_CURRENT)


def set_serial_command(serial: int) -> bytes:
    """Build the command that stores a serial number, 1..2^32 - 1."""
    return command(MessageType.COMMAND_SET_SERIAL, struct.pack("<I", serial))


def set_bandgap_command(bandgap_v: float) -> bytes:
    """Build the command that permanently stores the measured internal reference, 1.0..1.2 [V]."""
    return command(MessageType.COMMAND_SET_BANDGAP, struct.pack("<I", round(bandgap_v * 1e6)))


def set_divider_command(divider: float) -> bytes:
    """Build the command that permanently stores the divider ratio, 1..100."""
    return command(MessageType.COMMAND_SET_DIVIDER, struct.pack("<I", round(divider * 1e6)))


def set_current_slope_command(volts_per_ampere: float) -> bytes:
    """Build the command that stores the slope of the current sensor, 0.001..2; for a ratiometric sensor, that at 5 V [V/A]."""
    return command(MessageType.COMMAND_SET_CURRENT_SLOPE, struct.pack("<I", round(volts_per_ampere * 1e6)))


def set_ratiometric_command(ratiometric: int) -> bytes:
    """Build the command that stores 1 if the slope of the current sensor is proportional to the supply, otherwise 0."""
    return command(MessageType.COMMAND_SET_RATIOMETRIC, struct.pack("<I", ratiometric))


RELAY_KEEP, RELAY_LOW, RELAY_HIGH = range(3)
"""Codes of the relay's fallback level, which it takes when the host is silent."""
MAX_SILENT_S = 3600
"""Maximum delay of the fallback level [s]."""


def set_relay_command(relay: Relay) -> bytes:
    """Build the command that sets the relay pin."""
    return command(MessageType.COMMAND_SET_RELAY, struct.pack("<I", relay_word(relay)))


def relay_word(relay: Relay) -> int:
    """Encode the relay command: level in bit 0, fallback level in bits 8 and 9, and its delay [s] in the upper half."""
    fallback = RELAY_KEEP if relay.high_when_silent is None else RELAY_HIGH if relay.high_when_silent else RELAY_LOW
    return relay.high | fallback << 8 | relay.silent_s << 16


@dataclass(frozen=True)
class Hello:
    """Description that a board sends of itself, in the units of the line."""

    firmware_major: int
    firmware_minor: int
    firmware_patch: int
    reset_cause: int
    boot_id: int
    serial: int
    sequence: int
    board_us: int
    rate_hz: int
    period_ns: int
    adc_bits: int
    channels: int
    divider_ppm: int
    current_uv_per_a: int
    current_zero_ppm: int
    bandgap_uv: int
    bandgap_sum: int
    bandgap_count: int
    ntc_series_ohm: int
    ntc_r25_ohm: int
    ntc_beta_k: int

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<4BHIIIHIBBIIIIIHIIH")

    def encode(self, version: int = PROTOCOL_VERSION) -> bytes:
        """Return the frame of the message."""
        body = self.LAYOUT.pack(*(getattr(self, field.name) for field in fields(self)))
        return seal(bytes((version, MessageType.HELLO)) + body)

    @classmethod
    def decode(cls, packet: bytes) -> Self:
        """Decode a packet without its CRC.

        Raises:
            ProtocolError: The packet is another message.
        """
        return cls(*cls.LAYOUT.unpack(extract_body(packet, MessageType.HELLO, cls.LAYOUT.size)))

    @property
    def firmware(self) -> str:
        """Firmware version as text."""
        return f"{self.firmware_major}.{self.firmware_minor}.{self.firmware_patch}"

    @property
    def reference_v(self) -> float:
        """Full range of the converter, measured against the bandgap at the reset [V]; NaN if it was not measured."""
        if self.bandgap_sum == 0:
            return math.nan
        return self.bandgap_uv * 1e-6 * self.bandgap_count * (1 << self.adc_bits) / self.bandgap_sum


@dataclass(frozen=True)
class Ack:
    """Acknowledgment of a command."""

    command: int
    result: AckResult
    value: int

    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBI")

    def encode(self) -> bytes:
        """Return the frame of the message."""
        body = self.LAYOUT.pack(self.command, self.result, self.value)
        return seal(bytes((PROTOCOL_VERSION, MessageType.ACK)) + body)

    @classmethod
    def decode(cls, packet: bytes) -> Self:
        """Decode a packet without its CRC.

        Raises:
            ProtocolError: The packet is another message.
        """
        command_type, result, value = cls.LAYOUT.unpack(extract_body(packet, MessageType.ACK, cls.LAYOUT.size))
        try:
            return cls(command_type, AckResult(result), value)
        except ValueError as error:
            raise ProtocolError(str(error)) from None


@dataclass(frozen=True)
class SampleMessage:
    """Sample on the line: sums of conversions and their counts."""

    sequence: int
    board_us: int
    voltage_sum: int
    current_sum: int
    count: int
    aux_sum: int
    aux_count: int
    status: int

    HEAD: ClassVar[struct.Struct] = struct.Struct("<BBII")
    """Version, type, sequence and time, before the sums."""
    TAIL: ClassVar[struct.Struct] = struct.Struct("<HHBB")
    """Fields after the sums."""
    SUM_BYTES: ClassVar[int] = 3

    def encode(self, version: int = PROTOCOL_VERSION) -> bytes:
        """Return the frame of the message."""
        return seal(
            self.HEAD.pack(version, MessageType.SAMPLE, self.sequence, self.board_us)
            + self.voltage_sum.to_bytes(self.SUM_BYTES, "little")
            + self.current_sum.to_bytes(self.SUM_BYTES, "little")
            + self.TAIL.pack(self.count, self.aux_sum, self.aux_count, self.status)
        )

    @classmethod
    def decode(cls, packet: bytes) -> Self:
        """Decode a packet without its CRC.

        Raises:
            ProtocolError: The packet is another message.
        """
        body = extract_body(packet, MessageType.SAMPLE, cls.HEAD.size - 2 + 2 * cls.SUM_BYTES + cls.TAIL.size)
        sequence, board_us = struct.unpack_from("<II", body)
        sums_begin = cls.HEAD.size - 2  # the body has neither version nor type
        current_begin = sums_begin + cls.SUM_BYTES
        sums = (int.from_bytes(body[i : i + cls.SUM_BYTES], "little") for i in (sums_begin, current_begin))
        return cls(sequence, board_us, *sums, *cls.TAIL.unpack_from(body, current_begin + cls.SUM_BYTES))


def extract_body(packet: bytes, message_type: MessageType, size: int) -> bytes:
    """Return the body of a packet without CRC.

    Raises:
        ProtocolError: The packet has another version, type or length.
    """
    if packet[0] != PROTOCOL_VERSION:
        raise ProtocolError(f"protocol version {packet[0]}: this is version {PROTOCOL_VERSION}")
    if packet[1] != message_type:
        raise ProtocolError(f"message type {packet[1]:#04x} where {message_type:#04x} was expected")
    if len(packet) - 2 != size:
        raise ProtocolError(f"a body of {len(packet) - 2} bytes where {size} were expected")
    return packet[2:]
