"""JBD, also sold as Xiaoxiang, LLT Power, Overkill Solar: UART or RS485 at 9600 baud.

Request: ``DD A5 register 00 checksum 77``. Response: ``DD register status length data checksum 77``, big-endian. The
checksum is 0x10000 minus the sum of all bytes before it from the third on. Current: 10 mA per step, positive on
charge. Sources: the register map of bms-tools ("negative values indicate discharge") and the captures of esphome-jbd-bms and aiobmsble.
"""

import re
import struct
from collections.abc import Sequence

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.protocols.base.polled_protocol import (
    MAX_ATTACHED_AGE_S,
    Device,
    ParseResult,
    PolledProtocol,
    SensorDefaults,
)
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import RecentCellVoltages

BASIC, CELLS, NAME = 0x03, 0x04, 0x05
"""Registers of basic information, cell voltages and device name."""
START, END = 0xDD, 0x77
"""First and last byte of a frame."""
READ = 0xA5
"""Second byte of a request that reads a register."""
REFUSED = 0x80
"""Status of a response that rejects the request; 0 is success."""
HEAD_BYTES, TAIL_BYTES = 4, 3
"""Number of bytes of a frame before its data, and after them."""
MIN_BASIC_BYTES = 23
"""Length of the basic information before the probes [bytes]. Its last two bytes are the numbers of cells and probes."""
SOC_OFFSET = 19
"""Offset of the SOC in the basic information."""
MAX_DATA_BYTES = 128
"""Maximum length of the data of a frame [bytes]. 32 cells need 64 bytes."""
ZERO_C = 2731
"""Value at 0 degC [0.1 K]."""


def checksum(data: bytes) -> bytes:
    """Return the checksum of the bytes of a frame from the third one on."""
    return (-sum(data) & 0xFFFF).to_bytes(2, "big")


def request(register: int) -> bytes:
    """Build the request for a register; changes nothing."""
    return bytes((START, READ, register, 0)) + checksum(bytes((register, 0))) + bytes((END,))


class JbdProtocol(PolledProtocol):
    """Protocol of a JBD BMS. Each poll cycle requests cells and basic information, and the name until it is known.

    Args:
        current_sign: Direction of positive current. JBD's documentation states charge.
    """

    def __init__(self, *, current_sign: CurrentSign = "charge_positive") -> None:
        super().__init__("JBD BMS", re.compile(b"\xdd"), current_sign)
        self._recent_cells = RecentCellVoltages(MAX_ATTACHED_AGE_S)
        self._model = ""
        self._cell_count: int | None = None

    @property
    def description(self) -> str | None:
        """Name and number of cells; None before the basic information has arrived."""
        return None if self._cell_count is None else f"JBD BMS {self._model}".rstrip() + f", {self._cell_count} cells"

    def _query_variants(self) -> Sequence[Sequence[bytes]]:
        registers = (CELLS, BASIC) if self._model else (NAME, CELLS, BASIC)
        return ([request(register) for register in registers],)

    def _frame_length(self, data: bytes, at: int) -> int | ParseResult:
        if len(data) < at + HEAD_BYTES:
            return ParseResult.MORE if len(data) < at + 2 or data[at + 1] in (BASIC, CELLS, NAME) else ParseResult.NOISE
        _, register, status, length = data[at : at + HEAD_BYTES]
        if register not in (BASIC, CELLS, NAME) or status not in (0, REFUSED):
            return ParseResult.NOISE
        return HEAD_BYTES + length + TAIL_BYTES if length <= MAX_DATA_BYTES else ParseResult.LENGTH

    def _has_valid_checksum(self, frame: bytes) -> bool:
        return frame[-1] == END and checksum(frame[2:-TAIL_BYTES]) == frame[-TAIL_BYTES:-1]

    def _decode_frame(self, arrival_s: float, frame: bytes) -> Reading | None:
        register, status, data = frame[1], frame[2], frame[HEAD_BYTES:-TAIL_BYTES]
        if status == REFUSED:
            self._count_fault("refused", f"the BMS rejects a request of register 0x{register:02x}")
        elif register == NAME:
            self._model = data.decode("ascii", "replace").strip("\0 ")
        elif register == CELLS:
            self._recent_cells.store(arrival_s, [mv / 1000 for (mv,) in struct.iter_unpack(">H", _whole_words(data))])
        elif len(data) < MIN_BASIC_BYTES:
            self._count_fault("length_errors", "its basic information is too short")
        else:
            return self._decode_basic(arrival_s, data)
        return None

    def _decode_basic(self, arrival_s: float, data: bytes) -> Reading:
        centivolts, centiamperes, remaining_cah, capacity_cah = struct.unpack_from(">HhHH", data)
        self._cell_count, probes = data[MIN_BASIC_BYTES - 2 : MIN_BASIC_BYTES]
        probe_data = data[MIN_BASIC_BYTES:][: 2 * probes]
        return Reading(
            centivolts / 100,
            centiamperes / 100,
            tuple((step - ZERO_C) / 10 for (step,) in struct.iter_unpack(">H", _whole_words(probe_data))),
            self._recent_cells.at(arrival_s)[: self._cell_count],
            soc=data[SOC_OFFSET] / 100,
            remaining_ah=remaining_cah / 100,
            capacity_ah=capacity_cah / 100,
        )


def _whole_words(data: bytes) -> bytes:
    """Return the data without an odd byte at the end."""
    return data[: len(data) // 2 * 2]


DEVICE = Device(
    "jbd",
    lambda sensor: JbdProtocol(current_sign=sensor.current_sign),
    SensorDefaults(
        baud=9600,
        current_sign="charge_positive",
        period_s=1.0,
        voltage_resolution_v=0.01,
        current_resolution_a=0.01,
        current_dead_band_a=0.5,
    ),
    has_binary_frames=True,
)
"""One frame has voltage and current in steps of 10 mV and 10 mA. Users saw no current below 0.2 A, and with a BMS for 120 A no
current below 0.5 A (github.com/smagicld/xiaoxiangBMS, issues 115 and 39)."""
