"""Base class of polled devices whose responses are frames with a checksum: ``jbd``, ``daly`` and ``jk``."""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ECHO_FAULT, DeviceProtocol, ReadingProtocol, SensorCorrection

BMS_GAIN_STD = 0.005
"""Relative std of the gains of a BMS. Vendors state 0.5 % for the pack voltage, and seldom a smaller error."""


@dataclass(frozen=True)
class SensorDefaults:
    """Defaults of ``[sensor]`` for one kind of device. None: the default of the firmware's board."""

    baud: int | None = None
    """Baud rate of the serial port [1/s]."""
    current_sign: CurrentSign | None = None
    """Direction of the current that the device reports as positive."""
    period_s: float | None = None
    """Time between two samples [s]."""
    voltage_resolution_v: float | None = None
    """Smallest step of the pack's voltage [V]."""
    current_resolution_a: float | None = None
    """Smallest step of the current [A]."""
    current_dead_band_a: float | None = None
    """Current below which the device reports 0 [A]."""
    voltage_gain_std: float = BMS_GAIN_STD
    """Relative std of the voltage sensor's gain."""
    current_gain_std: float = BMS_GAIN_STD
    """Relative std of the current sensor's gain."""


class Sensor(Protocol):
    """Part of ``[sensor]`` that a protocol depends on."""

    @property
    def protocol(self) -> str:
        """Name of the protocol, one of ``PROTOCOLS``."""

    @property
    def current_sign(self) -> CurrentSign:
        """Direction of the current that the device reports as positive."""

    @property
    def address(self) -> int | None:
        """Address of the device on its bus; None: the first that responds."""

    @property
    def batteries(self) -> int | None:
        """Number of batteries whose values are summed; None: as many as the first reading has."""

    @property
    def sample_rate_hz(self) -> int:
        """Sample rate that a board of the firmware is set to [Hz]."""

    @property
    def correction(self) -> SensorCorrection:
        """Correction of the measured values."""


@dataclass(frozen=True)
class Device:
    """Kind of device.

    Each module of ``protocols.devices`` declares its device as the constant ``DEVICE``, and nowhere else.

    Attributes:
        name: Value of ``sensor.protocol``.
        make: Creates the protocol.
        sensor_defaults: Defaults of ``[sensor]``.
        has_binary_frames: True if the frames are not lines of text. A device search sends binary queries last, because a device that
            reads lines would interpret them as the beginning of a line.
        addresses: Valid values of ``sensor.address``; empty: the protocol has no addresses.
        max_batteries: Maximum number of batteries in parallel whose values are summed; 1: the protocol has one battery.
    """

    name: str
    make: Callable[[Sensor], DeviceProtocol]
    sensor_defaults: SensorDefaults
    has_binary_frames: bool = False
    addresses: range = range(0)
    max_batteries: int = 1


POLL_CYCLE_S = 1.0
"""Duration of a poll cycle [s], as in dbus-serialbattery."""
QUERY_INTERVAL_S = 0.22
"""Minimum interval between two queries [s]. The longest response, 48 cells of a Daly at 9600 baud, takes this long."""
MAX_UNANSWERED_CYCLES = 3
"""Number of unanswered poll cycles after which the next query variant is tried."""
MAX_NOISE_BYTES = 64
"""Maximum number of bytes without a frame before it is reported as a fault. Fewer may be a single glitch."""
MAX_START_BYTES = 4
"""Maximum length of the constant bytes at the start of a frame."""
FAULT_COUNTERS = ("crc_errors", "length_errors", "short_frames", "noise_bytes", "refused", "other_packs")
MAX_ATTACHED_AGE_S = 3.0
"""Values from a separate response are attached to a sample only if they are newer than this [s]."""


class ParseResult(Enum):
    """Result of parsing a frame start whose length cannot be determined."""

    MORE = "the beginning of the frame is incomplete"
    NOISE = "not a frame of this device"
    LENGTH = "the length of the frame is not valid"


class PolledProtocol(ReadingProtocol):
    """Protocol that polls a device in cycles and decodes its frames to samples. It takes no commands.

    Bytes outside frames are skipped one by one, so that the next complete frame is found. Apart from the sample times, the
    result does not depend on how the bytes are split into reads.

    Args:
        name: Name of the device, as text.
        start: Pattern of the bytes with which a frame begins.
        current_sign: Direction of positive current of the device; samples are positive on discharge.
        address: Address of the device on a shared line; None: the first that responds.
    """

    def __init__(
        self, name: str, start: re.Pattern[bytes], current_sign: CurrentSign, address: int | None = None
    ) -> None:
        super().__init__(current_sign, FAULT_COUNTERS)
        self._name, self._start, self._address = name, start, address
        self._unparsed = b""
        self._responses = 0  # number of valid frames
        self._noise_bytes = 0  # since the last valid frame
        self._last_bytes = b""
        self._has_echo = False  # True if the present query arrived since the last valid frame
        self._due_queries: list[bytes] = []
        self._query = b""
        self._variant_index = self._unanswered_cycles = 0
        self._responses_before = -1  # number of responses at the beginning of the last cycle; -1: no cycle yet
        self._cycle_s = self._query_s = -math.inf

    @property
    def fault(self) -> str | None:
        """First invalid response since the last sample."""
        if self._fault_text is None and self._noise_bytes > MAX_NOISE_BYTES:
            if self._has_echo:
                return ECHO_FAULT
            return f"bytes arrive that are no response of a {self._name}: wrong baud rate, or another sensor.protocol?"
        return self._fault_text

    @abstractmethod
    def _query_variants(self) -> Sequence[Sequence[bytes]]:
        """Return the request variants, each with the requests of one poll cycle. The first variant that is answered is used."""

    @abstractmethod
    def _frame_length(self, data: bytes, at: int) -> int | ParseResult:
        """Return the length of the frame that begins at ``at``, including start and checksum [bytes]."""

    @abstractmethod
    def _has_valid_checksum(self, frame: bytes) -> bool:
        """Return True if the checksum of a frame is right."""

    @abstractmethod
    def _decode_frame(self, arrival_s: float, frame: bytes) -> Reading | None:
        """Decode a whole frame; None if it is not a sample."""

    def on_port_opened(self) -> None:
        """Poll immediately, with the first variant.

        Decoded values are not reset, because a capture does not contain the openings of the port.
        """
        self._due_queries, self._variant_index, self._unanswered_cycles, self._responses_before = [], 0, 0, -1
        self._cycle_s = self._query_s = -math.inf

    def next_output(self, now_s: float) -> bytes:
        """Return the next query of the poll cycle; nothing while the device has time to respond."""
        if now_s - self._query_s < QUERY_INTERVAL_S:
            return b""
        if not self._due_queries:
            if now_s - self._cycle_s < POLL_CYCLE_S:
                return b""
            self._begin_cycle(now_s)
        self._query_s, self._query = now_s, self._due_queries.pop(0)
        return self._query

    def _begin_cycle(self, now_s: float) -> None:
        on_time = now_s - self._cycle_s < 2.0 * POLL_CYCLE_S
        self._cycle_s = self._cycle_s + POLL_CYCLE_S if on_time else now_s  # a short delay does not shift the schedule
        self._unanswered_cycles = self._unanswered_cycles + 1 if self._responses == self._responses_before else 0
        self._responses_before = self._responses
        if self._unanswered_cycles > MAX_UNANSWERED_CYCLES:
            self._variant_index, self._unanswered_cycles = self._variant_index + 1, 0
        variants = self._query_variants()
        self._due_queries = list(variants[self._variant_index % len(variants)])

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:
        self._last_bytes = (self._last_bytes + data)[-MAX_NOISE_BYTES:]
        self._has_echo |= bool(self._query) and self._query in self._last_bytes
        for frame in self._frames(data):
            self._responses += 1
            self._noise_bytes, self._has_echo = 0, False
            if (reading := self._decode_frame(arrival_s, frame)) is not None:
                yield reading

    def _frames(self, data: bytes) -> list[bytes]:
        """Return the complete frames that end in ``data``; store an incomplete frame for the next call."""
        buffer = self._unparsed + data
        frames, parsed_end = list[bytes](), 0
        incomplete_start = -1  # start of an incomplete frame; -1: none
        start = self._find_start(buffer, 0)
        while start >= 0:
            length = self._frame_length(buffer, start)
            if isinstance(length, int) and start + length > len(buffer):
                length = ParseResult.MORE
            if isinstance(length, int) and self._has_valid_checksum(buffer[start : start + length]):
                if incomplete_start >= 0:  # the frame that looked incomplete was cut off, because another one follows
                    self._count_fault(
                        "short_frames", "a response was cut off: interference, or a second master on the line?"
                    )
                self._skip(start - parsed_end)
                parsed_end, incomplete_start = start + length, -1
                frames.append(buffer[start:parsed_end])
                start = self._find_start(buffer, parsed_end)
                continue
            if incomplete_start < 0:  # the bytes of an incomplete frame are parsed again with the next read
                if length is ParseResult.MORE:
                    incomplete_start = start
                elif length is ParseResult.LENGTH:
                    self._count_fault(
                        "length_errors", "responses with invalid lengths arrive: interference, or a wrong baud rate?"
                    )
                elif length is not ParseResult.NOISE:
                    self._count_fault(
                        "crc_errors",
                        "responses with wrong checksums arrive: interference, or a second master on the line?",
                    )
            start = self._find_start(buffer, start + 1)
        # without an incomplete frame, only the last bytes may be the beginning of a frame
        end = incomplete_start if incomplete_start >= 0 else max(parsed_end, len(buffer) - MAX_START_BYTES + 1)
        self._skip(end - parsed_end)
        self._unparsed = buffer[end:]
        return frames

    def _find_start(self, data: bytes, at: int) -> int:
        """Return the position of the next possible frame start; -1 without one."""
        match = self._start.search(data, at)
        return match.start() if match else -1

    def _skip(self, count: int) -> None:
        """Skip bytes outside of frames."""
        self._counts["noise_bytes"] += count
        self._noise_bytes += count

    def _is_other_pack(self, address: int) -> bool:
        """Return True if a response is from another pack.

        Without a configured address the first response selects the pack.
        """
        if self._address is None:
            self._address = address
        if address == self._address:
            return False
        self._count_fault(
            "other_packs", f"pack {address} responds, but pack {self._address} is selected: see sensor.address"
        )
        return True
