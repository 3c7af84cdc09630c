"""JK-BMS (Jikong) over its serial port at 115200 baud: two families of frames, which are both decoded.

``4E 57`` (B series, port "GPS", TTL, or RS485 by adapter), big-endian: 4E 57, length without these two, terminal, command, source,
type, registers, record number, 68, checksum: the sum of all bytes before it. Request: "read all". Source: JK's "BMS-RS485
communication protocol" 2.5 as in esphome-jk-bms. Current: 10 mA per step. In version 0 (register
C0) the value is 10000 at zero and decreases on charge; in version 1 the highest bit is set on charge.

``55 AA EB 90`` (PB series, RS485-2), little-endian: 300 bytes, of which the last is the sum of the others, then a Modbus record of eight
bytes that begins with the pack's address. The master of a line sends it unsolicited, other packs on a Modbus request.
Steps of 1 mV and 1 mA, current positive on charge. Sources: the captures of esphome-jk-bms, jk-bms-passive-bridge and dbus-serialbattery.
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.protocols.base.polled_protocol import Device, ParseResult, PolledProtocol, SensorDefaults
from bms_estimator.protocols.base.reading import Reading

OLD_START, START = b"\x4e\x57", b"\x55\xaa\xeb\x90"
"""First bytes of an older and of a newer frame."""
OLD_HEAD, OLD_TAIL = 11, 9
"""Number of bytes of an older frame before its registers, and after them."""
OLD_MAX_BYTES = 512
"""Maximum length of an older frame [bytes]."""
READ_ALL, FROM_BMS, ANSWER, OLD_END = 0x06, 0x00, 0x01, 0x68
"""Command, source, type and end mark of an older response."""
REGISTER_BYTES: Mapping[int, int] = {
    **dict.fromkeys(range(0x80, 0xC1), 2),
    **dict.fromkeys((0x85, 0x86, 0x9D, 0xA9, 0xAB, 0xAC, 0xAE, 0xAF, 0xB1, 0xB3, 0xB8, 0xC0), 1),
    **dict.fromkeys((0x89, 0xAA, 0xB5, 0xB6, 0xB9), 4),
    0xB2: 10,
    0xB4: 8,
    0xB7: 15,
    0xBA: 24,
}
"""Length of each register [bytes], except that of the cells, which contains its own length."""
CELLS, BOX_C, BATTERY_C, VOLTAGE, CURRENT, SOC, CAPACITY, SOFTWARE, VERSION = (
    *(0x79, 0x81, 0x82, 0x83, 0x84),
    *(0x85, 0xAA, 0xB7, 0xC0),
)
"""Registers of an older frame."""
MINUS_ZERO = 100
"""Value of a probe at -0 degC in an older frame. Larger values are negative temperatures."""
ABSENT_C = 140
"""Value of an absent probe in an older frame: the lower end of the scale, -40 degC."""
CHARGING = 0x8000
"""Bit of the current in an older frame of protocol version 1 that is set on charge."""

ZERO_CURRENT = 10_000
"""Value at 0 A in an older frame of protocol version 0 [10 mA]."""

FRAME_BYTES, RECORD_BYTES = 300, 8
"""Length of a newer frame, and of the Modbus record after it [bytes]."""
REALTIME = 0x02
"""Kind of a newer frame with measured values."""
CELLS_OFFSET, CELL_BITS_OFFSET, VOLTAGE_OFFSET, CURRENT_OFFSET = 6, 70, 150, 158
"""Offsets in a newer frame of the voltages of 32 cells, a bit for each present cell, voltage and current."""
SOC_OFFSET, REMAINING_OFFSET = 173, 174
"""Offsets in a newer frame of the SOC, and of remaining charge and capacity."""
PROBE_OFFSETS = {1: 162, 2: 164, 4: 256, 5: 258}
"""Offsets in a newer frame of the battery's probes, by JK's number; the boards have no third one."""
PROBE_BITS_OFFSET = 214
"""Offset in a newer frame of a bit for each connected probe, by its number. Older boards, with two probes, send 0."""
KINDS = (0x01, 0x02, 0x03)
"""Valid kinds of newer frames."""
MODBUS_WRITE = 0x10
"""Modbus function that writes registers."""
REALTIME_REGISTER = 0x1620
"""Register whose write requests a real-time frame."""
ABSENT_DECI_C = -2000
"""Value of an absent probe in a newer frame [0.1 degC]."""
LISTEN_S = 10.0
"""Time without queries after unsolicited frames [s]. Another master polls every 6 s."""


def crc16(data: bytes) -> bytes:
    """Return the Modbus CRC in byte order of the line."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def with_old_checksum(frame: bytes) -> bytes:
    """Append the checksum of an older frame."""
    return frame + (sum(frame) & 0xFFFF).to_bytes(4, "big")


OLD_REQUEST = with_old_checksum(OLD_START + bytes((0, 19, 0, 0, 0, 0, READ_ALL, 3, 0, 0, 0, 0, 0, 0, OLD_END)))
"""Request to read all registers; it changes nothing."""


def request(address: int) -> bytes:
    """Build the request for a pack's real-time frame: a Modbus write, which only this BMS treats as a request."""
    frame = struct.pack(">BBHHBH", address, MODBUS_WRITE, REALTIME_REGISTER, 1, 2, 0)
    return frame + crc16(frame)


class JkProtocol(PolledProtocol):
    """Protocol of a JK-BMS of either family.

    Args:
        current_sign: Direction of positive current. JK's documentation states charge.
        address: Address of the pack on a shared line; None: the first that responds.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive", address: int | None = None) -> None:
        super().__init__("JK-BMS", re.compile(re.escape(OLD_START) + b"|" + re.escape(START)), current_sign, address)
        self._description: str | None = None
        self._overheard_s = -math.inf  # arrival time of the last unsolicited frame

    @property
    def description(self) -> str | None:
        """Number of cells, and software version or address; None before the first frame."""
        return self._description

    @property
    def allowed_silence_s(self) -> float:
        """Maximum time without data [s]. It is longer if another master polls."""
        return LISTEN_S if math.isfinite(self._overheard_s) else 0.0

    @property
    def _polled_packs(self) -> Sequence[int]:
        """Addresses that are polled with the newer request, in turn."""
        return (1, 0) if self._address is None else (self._address,)

    def _query_variants(self) -> Sequence[Sequence[bytes]]:
        newer = [] if self.probing else [[request(address)] for address in self._polled_packs]
        return [[OLD_REQUEST], *newer]

    def on_port_opened(self) -> None:
        """Reset; another master is unknown until its next frame."""
        super().on_port_opened()
        self._overheard_s = -math.inf

    def next_output(self, now_s: float) -> bytes:
        """Return the query, unless another master polls and its responses are received."""
        return b"" if now_s - self._overheard_s < LISTEN_S else super().next_output(now_s)

    def _frame_length(self, data: bytes, at: int) -> int | ParseResult:
        return self._old_length(data, at) if data[at] == OLD_START[0] else self._newer_length(data, at)

    def _old_length(self, data: bytes, at: int) -> int | ParseResult:
        if len(data) < at + OLD_HEAD:
            return ParseResult.MORE
        length = int.from_bytes(data[at + 2 : at + 4], "big") + len(OLD_START)
        if not OLD_HEAD + OLD_TAIL <= length <= OLD_MAX_BYTES:
            return ParseResult.LENGTH
        command, _, kind = data[at + 8 : at + OLD_HEAD]
        return length if (command, kind) == (READ_ALL, ANSWER) else ParseResult.NOISE

    def _newer_length(self, data: bytes, at: int) -> int | ParseResult:
        if len(data) <= at + len(START):
            return ParseResult.MORE
        if data[at + len(START)] not in KINDS:
            return ParseResult.NOISE
        record = data[at + FRAME_BYTES : at + FRAME_BYTES + RECORD_BYTES]
        has_record = len(record) < RECORD_BYTES or crc16(record[:-2]) == record[-2:]  # a short record is incomplete
        return FRAME_BYTES + RECORD_BYTES if has_record else FRAME_BYTES

    def _has_valid_checksum(self, frame: bytes) -> bool:
        if frame.startswith(OLD_START):
            return frame[-5] == OLD_END and with_old_checksum(frame[:-4]) == frame
        return sum(frame[: FRAME_BYTES - 1]) & 0xFF == frame[FRAME_BYTES - 1]

    def _decode_frame(self, arrival_s: float, frame: bytes) -> Reading | None:
        return self._decode_old(frame) if frame.startswith(OLD_START) else self._decode_newer(arrival_s, frame)

    def _decode_old(self, frame: bytes) -> Reading | None:
        if self._is_other_pack(frame[7]):  # last byte of the terminal number
            return None
        registers = dict(_registers(frame[OLD_HEAD:-OLD_TAIL]))
        if not {VOLTAGE, CURRENT} <= registers.keys():
            self._count_fault("length_errors", "its response contains no voltage or no current")
            return None
        cells_v = [mv / 1000 for _, mv in struct.iter_unpack(">BH", registers.get(CELLS, b""))]
        self._description = f"JK-BMS, {len(cells_v)} cells"
        if software := registers.get(SOFTWARE, b"").decode("ascii", "replace").strip("\0 _"):
            self._description += f", software {software}"
        raw = _number(registers[CURRENT])
        if _number(registers.get(VERSION, b"\0")) == 0:
            current_a = (ZERO_CURRENT - raw) / 100
        else:
            current_a = (raw & ~CHARGING) / (100 if raw & CHARGING else -100)
        probes = [_number(registers[code]) for code in (BOX_C, BATTERY_C) if code in registers]
        probes_c = tuple(math.nan if probe == ABSENT_C else _old_celsius(probe) for probe in probes)
        return Reading(
            _number(registers[VOLTAGE]) / 100,
            current_a,
            probes_c,
            tuple(cells_v),
            soc=_number(registers[SOC]) / 100 if SOC in registers else math.nan,
            capacity_ah=float(_number(registers[CAPACITY])) if CAPACITY in registers else math.nan,
        )

    def _decode_newer(self, arrival_s: float, frame: bytes) -> Reading | None:
        address = frame[FRAME_BYTES] if len(frame) > FRAME_BYTES else None
        if address is not None and request(address) != self._query:  # the response to another master
            self._overheard_s = arrival_s
        if (address is not None and self._is_other_pack(address)) or frame[4] != REALTIME:
            return None
        (cell_bits,) = struct.unpack_from("<I", frame, CELL_BITS_OFFSET)
        (millivolts,) = struct.unpack_from("<I", frame, VOLTAGE_OFFSET)
        (milliamperes,) = struct.unpack_from("<i", frame, CURRENT_OFFSET)
        cells = struct.unpack_from("<32H", frame, CELLS_OFFSET)
        cells_v = [mv / 1000 for i, mv in enumerate(cells) if cell_bits >> i & 1]
        self._description = f"JK-BMS, {len(cells_v)} cells" + ("" if address is None else f", pack {address}")
        probes_c = tuple(_newer_celsius(frame, number) for number in range(1, max(PROBE_OFFSETS) + 1))
        remaining_mah, capacity_mah = struct.unpack_from("<2I", frame, REMAINING_OFFSET)
        return Reading(
            millivolts / 1000,
            milliamperes / 1000,
            probes_c,
            tuple(cells_v),
            soc=frame[SOC_OFFSET] / 100,
            remaining_ah=remaining_mah / 1000,
            capacity_ah=capacity_mah / 1000,
        )


def _registers(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield code and content of each register up to the first unknown one.

    The protocol version, at the end of the registers, is yielded first, because an unknown register may precede it.
    """
    if data[-2:-1] == bytes((VERSION,)):
        yield VERSION, data[-1:]
    at = 0
    while at < len(data):
        code, at = data[at], at + 1
        if code == CELLS and at < len(data):
            length, at = data[at] // 3 * 3, at + 1  # three bytes for each cell: its number and its voltage
        else:
            length = REGISTER_BYTES.get(code, 0)
        content, at = data[at : at + length], at + length
        if not length or len(content) < length:
            return
        yield code, content


def _old_celsius(byte: int) -> float:
    """Return the temperature of a probe in an older frame [C]: 101 is -1 C."""
    return float(byte if byte < MINUS_ZERO else MINUS_ZERO - byte)


def _newer_celsius(frame: bytes, number: int) -> float:
    """Return the temperature of a probe in a newer frame [C]; NaN if it is absent."""
    is_connected = number <= 2 or frame[PROBE_BITS_OFFSET] >> number & 1
    if number not in PROBE_OFFSETS or not is_connected:
        return math.nan
    (step,) = struct.unpack_from("<h", frame, PROBE_OFFSETS[number])
    return math.nan if step == ABSENT_DECI_C else step / 10


def _number(content: bytes) -> int:
    return int.from_bytes(content, "big")


DEVICE = Device(
    "jk",
    lambda sensor: JkProtocol(current_sign=sensor.current_sign, address=sensor.address),
    SensorDefaults(
        baud=115_200,
        current_sign="charge_positive",
        period_s=1.0,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
        current_dead_band_a=0.7,
    ),
    has_binary_frames=True,
    addresses=range(256),
)
"""One frame has voltage and current in steps of 10 mV and 10 mA. One board showed nothing below 0.7 A
(github.com/syssi/esphome-jk-bms, issue 243)."""
