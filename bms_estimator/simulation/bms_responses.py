"""Responses of a simulated BMS to each request, by protocol: the encoders for the decoders in ``protocols.devices``."""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from bms_estimator.protocols.devices import daly, jbd, jk

NAME = b"SIMULATED"
"""Name or software version that the BMS reports."""
ADDRESS = 1
"""Address of the simulated Daly and of the newer JK."""
JBD_SOFTWARE, JBD_SWITCHES_ON = 0x20, 0b11
"""Software version 2.0; bits of the charge and the discharge switch, both on."""
JK_SWITCHES_C, JK_PROBES, JK_CELL_COUNT = 0x80, 0x86, 0x8A
"""Registers of an older JK that the decoder does not use. The first is the temperature of the switches."""
JK_OLD_MIN_C, JK_OLD_MAX_C = -39, 100
"""Range of a temperature of an older JK [degC]. The value for -40 means an absent probe."""


@dataclass(frozen=True)
class Measured:
    """Last measured values; current positive on discharge, temperature NaN without a probe."""

    voltage_v: float
    current_a: float
    temperature_c: float
    cells_v: Sequence[float]
    soc: float
    capacity_ah: float


ResponseEncoders = Mapping[bytes, Callable[[Measured], bytes]]
"""Function that encodes the response, by request."""


def _to_steps(value: float, per_unit: float, minimum: int, maximum: int) -> int:
    """Convert a value to an integer number of steps, limited to a range. ``per_unit`` steps are one unit of the value."""
    return min(max(round(value * per_unit), minimum), maximum)


def _to_u16(value: float, per_unit: float) -> int:
    return _to_steps(value, per_unit, 0, 0xFFFF)


def _jbd_frame(register: int, data: bytes) -> bytes:
    body = bytes((0, len(data))) + data
    return bytes((jbd.START, register)) + body + jbd.checksum(body) + bytes((jbd.END,))


def _jbd_basic(measured: Measured) -> bytes:
    probes = [] if math.isnan(measured.temperature_c) else [_to_u16(measured.temperature_c + jbd.ZERO_C / 10, 10)]
    data = struct.pack(
        ">HhHHHHHHHBBBBB",
        *(_to_u16(measured.voltage_v, 100), _to_steps(-measured.current_a, 100, -0x8000, 0x7FFF)),
        *(_to_u16(measured.soc * measured.capacity_ah, 100), _to_u16(measured.capacity_ah, 100)),
        *(0, 0, 0, 0, 0),  # cycles, production date, balancing of cells 1 to 16 and 17 to 32, protection
        *(JBD_SOFTWARE, _to_steps(measured.soc, 100, 0, 100), JBD_SWITCHES_ON, len(measured.cells_v), len(probes)),
    )
    return _jbd_frame(jbd.BASIC, data + struct.pack(f">{len(probes)}H", *probes))


def _jbd_cells(measured: Measured) -> bytes:
    return _jbd_frame(
        jbd.CELLS, struct.pack(f">{len(measured.cells_v)}H", *(_to_u16(v, 1000) for v in measured.cells_v))
    )


def _daly_frame(command: int, data: bytes) -> bytes:
    return daly.with_checksum(
        bytes((daly.START, ADDRESS, command, daly.DATA_BYTES)) + data.ljust(daly.DATA_BYTES, b"\0")
    )


def _daly_status(measured: Measured) -> bytes:
    return _daly_frame(daly.STATUS, bytes((len(measured.cells_v), int(not math.isnan(measured.temperature_c)))))


def _daly_cells(measured: Measured) -> bytes:
    count = daly.CELLS_PER_FRAME
    steps = [_to_u16(v, 1000) for v in measured.cells_v] + [0] * (count - 1)  # fills up the last frame
    frames = range(math.ceil(len(measured.cells_v) / count))
    return b"".join(
        _daly_frame(daly.CELLS, struct.pack(">B3H", i + 1, *steps[count * i : count * (i + 1)])) for i in frames
    )


def _daly_probes(measured: Measured) -> bytes:
    has_probe = not math.isnan(measured.temperature_c)
    probe_byte = _to_steps(measured.temperature_c + daly.ZERO_C, 1, 1, 255) if has_probe else 0
    return _daly_frame(daly.PROBES, bytes((1, probe_byte)))  # frame number 1


def _daly_pack(measured: Measured) -> bytes:
    voltage_word = _to_u16(measured.voltage_v, 10)
    current_word = _to_u16(measured.current_a + daly.ZERO_CURRENT / 10, 10)
    return _daly_frame(daly.PACK, struct.pack(">4H", voltage_word, 0, current_word, _to_u16(measured.soc, 1000)))


def _jk_old(measured: Measured) -> bytes:
    current_word = _to_steps(abs(measured.current_a), 100, 0, jk.CHARGING - 1)
    if measured.current_a < 0.0:
        current_word |= jk.CHARGING
    if math.isnan(measured.temperature_c):
        probe_word = jk.ABSENT_C
    else:
        temperature_c = _to_steps(measured.temperature_c, 1, JK_OLD_MIN_C, JK_OLD_MAX_C)
        probe_word = temperature_c if temperature_c >= 0 else 100 - temperature_c  # -5 is sent as 105
    cells = b"".join(struct.pack(">BH", i, _to_u16(v, 1000)) for i, v in enumerate(measured.cells_v, 1))
    registers = (
        bytes((jk.CELLS, len(cells)))
        + cells
        + struct.pack(">BHBHBH", JK_SWITCHES_C, probe_word, jk.BOX_C, probe_word, jk.BATTERY_C, probe_word)
        + struct.pack(">BHBH", jk.VOLTAGE, _to_u16(measured.voltage_v, 100), jk.CURRENT, current_word)
        + struct.pack(">BBBB", jk.SOC, _to_steps(measured.soc, 100, 0, 100), JK_PROBES, 2)
        + struct.pack(">BHBI", JK_CELL_COUNT, len(measured.cells_v), jk.CAPACITY, round(measured.capacity_ah))
        + bytes((jk.SOFTWARE,))
        + NAME.ljust(15, b"_")
        + bytes((jk.VERSION, 1))
    )
    # terminal number, command, source and type before the registers; record number and end mark after them
    head = bytes((0, 0, 0, 0, jk.READ_ALL, jk.FROM_BMS, jk.ANSWER))
    body = head + registers + bytes((0, 0, 0, 0, jk.OLD_END))
    length = 2 + len(body) + 4  # the length field, the body and the checksum
    return jk.with_old_checksum(jk.OLD_START + length.to_bytes(2, "big") + body)


def _jk_newer(measured: Measured) -> bytes:
    frame = bytearray(jk.FRAME_BYTES)
    # offsets of a real-time frame: cell voltages 6, bits of the present cells 70, voltage 150, current 158,
    # two temperatures 162, SOC 173. The bits of further probes, at 214, are 0
    frame[:5] = jk.START + bytes((jk.REALTIME,))
    struct.pack_into(f"<{len(measured.cells_v)}H", frame, 6, *(_to_u16(v, 1000) for v in measured.cells_v))
    struct.pack_into("<I", frame, 70, (1 << len(measured.cells_v)) - 1)
    struct.pack_into("<I", frame, 150, round(1000 * measured.voltage_v))
    struct.pack_into("<i", frame, 158, round(-1000 * measured.current_a))
    probe_word = jk.ABSENT_DECI_C if math.isnan(measured.temperature_c) else round(10 * measured.temperature_c)
    struct.pack_into("<2h", frame, 162, probe_word, probe_word)
    frame[173] = _to_steps(measured.soc, 100, 0, 100)
    frame[-1] = sum(frame) & 0xFF
    # the BMS sends the frame first, then the Modbus response to the request, which is a write
    record = struct.pack(">BBHH", ADDRESS, jk.MODBUS_WRITE, jk.REALTIME_REGISTER, 1)
    return bytes(frame) + record + jk.crc16(record)


BMS_RESPONSES: Mapping[str, ResponseEncoders] = {
    "jbd": {
        jbd.request(jbd.NAME): lambda _: _jbd_frame(jbd.NAME, NAME),
        jbd.request(jbd.CELLS): _jbd_cells,
        jbd.request(jbd.BASIC): _jbd_basic,
    },
    "daly": {
        daly.request(daly.HOSTS[0], daly.STATUS): _daly_status,
        daly.request(daly.HOSTS[0], daly.CELLS): _daly_cells,
        daly.request(daly.HOSTS[0], daly.PROBES): _daly_probes,
        daly.request(daly.HOSTS[0], daly.PACK): _daly_pack,
    },
    "jk": {jk.OLD_REQUEST: _jk_old},
    "jk-pb": {jk.request(ADDRESS): _jk_newer},
}
"""Responses by protocol. ``jk`` is the older, ``jk-pb`` the newer family of JK."""
MAX_CELLS = 32
"""Maximum number of cells that the frames of all protocols can hold."""
