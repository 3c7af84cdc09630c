"""Daly Smart BMS, protocol of the ``A5`` frames: UART or RS485 at 9600 baud.

Request: ``A5 host command 08``, eight zeros, checksum; the host is 40 on RS485 and USB, 80 on UART. A request to board n of a shared
line has 3F + n in place of 40, and its response has n in place of 01 (dbus-serialbattery). Response: ``A5 01 command 08``, eight bytes, checksum, big-endian; cells and probes are in several frames, each with its number as first byte. The checksum is the sum of all
bytes before it, modulo 256. Current: 0.1 A per step, 30000 at zero, positive on discharge as in python-daly-bms, batmon-ha and
dbus-serialbattery. Some firmwares report the opposite sign (dbus-serialbattery issues 65, 70, 255), which
``sensor.current_sign`` corrects.
Frame numbers of cells begin with 1, or with 0 as in Daly's own document. Newer boards (H, K, M, S) speak Modbus instead.
"""

import math
import re
import struct
from collections.abc import Mapping, Sequence

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.protocols.base.polled_protocol import (
    MAX_ATTACHED_AGE_S,
    Device,
    ParseResult,
    PolledProtocol,
    SensorDefaults,
)
from bms_estimator.protocols.base.reading import Reading

PACK, STATUS, CELLS, PROBES = 0x90, 0x94, 0x95, 0x96
"""Commands for voltage and current of the pack, numbers of cells and probes, cell voltages, and temperatures."""
COMMANDS = range(0x90, 0x99)
"""Valid commands of responses."""
START = 0xA5
"""First byte of a frame."""
DATA_BYTES, FRAME_BYTES = 8, 13
"""Number of data bytes of a frame, and of all its bytes."""
HOSTS = (0x40, 0x80)
"""Second byte of a request to board 1: on RS485 or USB, and on UART."""
PACK_ADDRESSES = range(0x01, 0x40)
"""Board numbers, the second byte of responses."""
ZERO_CURRENT = 30000
"""Value at 0 A [0.1 A]."""
ZERO_C = 40
"""Value at 0 degC [degC]. The value 0 means an absent probe."""
CELLS_PER_FRAME, PROBES_PER_FRAME = 3, 7
"""Number of values in a frame of cells, and in a frame of probes."""
MAX_FRAMES = 16
"""Maximum number of frames of cells or probes."""


def with_checksum(frame: bytes) -> bytes:
    """Append the checksum."""
    return frame + bytes((sum(frame) & 0xFF,))


def request(host: int, command: int) -> bytes:
    """Build the request for ``command`` with this second byte. The commands used here only read from the BMS."""
    return with_checksum(bytes((START, host, command, DATA_BYTES)) + bytes(DATA_BYTES))


class DalyProtocol(PolledProtocol):
    """Protocol of a Daly BMS. Each poll cycle requests cells, probes and pack, and the number of cells until it is known.

    Args:
        current_sign: Direction of positive current. Daly's documentation states discharge.
        address: Board number of the BMS on a shared line; None: board 1, or whichever responds to its requests.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive", address: int | None = None) -> None:
        super().__init__("Daly BMS", re.compile(b"\xa5"), current_sign, address)
        self._hosts = HOSTS if address in (None, 1) else (HOSTS[0] - 1 + address,)
        self._cell_count: int | None = None
        self._probe_count: int | None = None
        self._has_sample = False
        self._has_status = False  # True once a status was received after the port was opened
        self._first_frame_number = 1  # number of the frame with cell 1
        self._cells_v: dict[int, Sequence[float]] = {}  # voltages by frame number [V]
        self._probes_c: dict[int, Sequence[float]] = {}
        self._cells_s = self._probes_s = -math.inf

    @property
    def description(self) -> str | None:
        """Number of cells; None until the number and a sample have arrived."""
        return f"Daly BMS, {self._cell_count} cells" if self._has_sample and self._cell_count is not None else None

    def on_port_opened(self) -> None:
        """Reset; the pack may be another one, with more cells."""
        super().on_port_opened()
        self._has_status = False

    def _query_variants(self) -> Sequence[Sequence[bytes]]:
        if self.probing:
            return [[request(host, command) for host in HOSTS for command in (STATUS, CELLS, PACK)]]
        commands = (CELLS, PROBES, PACK) if self._has_status else (STATUS, CELLS, PROBES, PACK)
        return [[request(host, command) for command in commands] for host in self._hosts]

    def _frame_length(self, data: bytes, at: int) -> int | ParseResult:
        head = data[at + 1 : at + 4]
        if any(byte not in allowed for byte, allowed in zip(head, (PACK_ADDRESSES, COMMANDS), strict=False)):
            return ParseResult.NOISE
        if len(head) < 3:
            return ParseResult.MORE
        return FRAME_BYTES if head[2] == DATA_BYTES else ParseResult.LENGTH

    def _has_valid_checksum(self, frame: bytes) -> bool:
        return with_checksum(frame[:-1]) == frame

    def _decode_frame(self, arrival_s: float, frame: bytes) -> Reading | None:
        if self._is_other_pack(frame[1]):
            return None
        command, data = frame[2], frame[4:-1]
        if command == PACK:
            return self._decode_pack(arrival_s, data)
        if command == STATUS:
            self._cell_count, self._probe_count, self._has_status = data[0] or None, data[1], True
        elif command in (CELLS, PROBES) and data[0] > MAX_FRAMES:
            self._count_fault("length_errors", f"a frame has number {data[0]}, and there are at most {MAX_FRAMES}")
        elif command == CELLS:
            self._first_frame_number = 0 if data[0] == 0 else self._first_frame_number
            self._cells_v[data[0]], self._cells_s = [mv / 1000 for mv in struct.unpack_from(">3H", data, 1)], arrival_s
        elif command == PROBES:
            self._probes_c[data[0]], self._probes_s = [c - ZERO_C if c else math.nan for c in data[1:]], arrival_s
        return None

    def _decode_pack(self, arrival_s: float, data: bytes) -> Reading:
        decivolts, _, deciamperes, permille = struct.unpack(">4H", data)
        cells_v = (
            self._join_frames(self._cells_v, CELLS_PER_FRAME, self._cell_count)
            if arrival_s - self._cells_s < MAX_ATTACHED_AGE_S
            else []
        )
        while self._cell_count is None and cells_v and not cells_v[-1] > 0.0:
            cells_v.pop()  # unused positions of the last frame have 0 V
        has_recent_probes = arrival_s - self._probes_s < MAX_ATTACHED_AGE_S
        probes_c = self._join_frames(self._probes_c, PROBES_PER_FRAME, self._probe_count) if has_recent_probes else []
        # each cell voltage is part of one sample only; temperatures are repeated for up to ``MAX_ATTACHED_AGE_S``
        self._cells_v, self._has_sample = {}, True
        current_a = (deciamperes - ZERO_CURRENT) / 10
        return Reading(decivolts / 10, current_a, tuple(probes_c), tuple(cells_v), soc=permille / 1000)

    def _join_frames(
        self, frames: Mapping[int, Sequence[float]], values_per_frame: int, count: int | None
    ) -> list[float]:
        """Return the values of all frames in the order of their numbers; NaN for a missing frame.

        Args:
            frames: Frames by number.
            values_per_frame: Number of values in one frame.
            count: Number of values; None: unknown, so that the unused positions of the last frame are also returned.
        """
        if not frames:
            return []
        missing_frame = [math.nan] * values_per_frame
        numbers = range(self._first_frame_number, max(frames) + 1)
        values = [value for number in numbers for value in frames.get(number, missing_frame)]
        return values if count is None else (values + [math.nan] * count)[:count]


DEVICE = Device(
    "daly",
    lambda sensor: DalyProtocol(current_sign=sensor.current_sign, address=sensor.address),
    SensorDefaults(
        baud=9600,
        current_sign=None,
        period_s=1.0,
        voltage_resolution_v=0.1,
        current_resolution_a=0.1,
        current_dead_band_a=2.5,
    ),
    has_binary_frames=True,
    addresses=PACK_ADDRESSES,
)
"""Registration of the protocol. Voltage and current have steps of 0.1 V and 0.1 A.

The BMS reports 0 A below its parameter DfilterCur. Users found values of 2 A and 2.5 A (github.com/softwarecrash/Daly2MQTT,
issue 171; github.com/fl4p/batmon-ha, issue 144).
"""
