"""Decoder of the firmware's frames to samples: state, messages and counters around the kernels of ``framing``."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import SAMPLE, CurrentSign, SampleBlock
from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.protocols.firmware.clock_drift import clock_ppm
from bms_estimator.protocols.firmware.framing import DECODER, HELLO_BYTES, PACKET_BYTES, SAMPLE_FRAME_BYTES, decode
from bms_estimator.protocols.firmware.messages import (
    DELIMITER,
    MODULUS,
    Ack,
    AckResult,
    Hello,
    MessageType,
    ProtocolError,
    unseal,
)
from bms_estimator.protocols.firmware.scaling import SCALING, reference

MAX_BYTES_WITHOUT_FRAME = 512
"""Maximum number of bytes without a valid frame, eight times the longest frame. More is reported as a fault."""
MAX_CLOCK_PPM = 20_000.0
"""Maximum plausible rate error of a clock [1e-6]. A larger one shows a suspended host or an accelerated simulation."""
HELLO_FRAME_BYTES = HELLO_BYTES + 1
"""Length of a COBS-encoded hello without its delimiter [bytes]."""
_MAX_MESSAGES = 8
"""Maximum number of messages of one call of the kernel, and of stored acknowledgments."""


class FrameFault(Enum):
    """Fault of the line as a whole; the value is its text."""

    WRONG_BAUD = "bytes come, but no valid frame among them: wrong baud rate?"
    TEXT = 'the board prints text, not frames: set sensor.protocol = "text"; without a settings file, use --text'
    NEWER_PROTOCOL = "the board uses another version of the protocol: update this program or the firmware"
    NO_HELLO = "frames arrive, but the board has not sent its scaling yet"


@dataclass(frozen=True)
class FrameCounters:
    """Counters of the line since start."""

    bytes_received: int = 0
    frames_received: int = 0
    """Decoded samples; frames of other types do not count."""
    frames_lost: int = 0
    """Frames missing in the sequence, for any reason."""
    crc_errors: int = 0
    cobs_errors: int = 0
    length_errors: int = 0
    version_errors: int = 0
    """Frames of another version of the protocol."""
    type_errors: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    before_hello: int = 0
    """Samples that arrived before their scaling was known, or while another board may have been connected."""
    overruns: int = 0
    """Samples before which the board dropped others, because its send buffer was full."""
    implausible: int = 0
    """Implausible temperatures, which were replaced by NaN."""
    resets: int = 0
    clock_jumps: int = 0
    """Number of restarts of the board's clock from the arrival time.

    The clock is restarted if a sample arrives long before its timestamp, or if its timestamp has advanced by more than the
    arrival time, the sequence numbers and a known gap allow.
    """

    def as_dict(self) -> dict[str, int]:
        """Return the counters by name."""
        return dict(vars(self))


class FrameDecoder:
    """Decoder of a board's bytes to samples.

    The samples depend only on the calls of ``feed``. Invalid bytes raise no error; faults are counted by kind.

    Args:
        current_sign: Direction of positive current of the board; samples are positive on discharge.

    Attributes:
        hellos: Number of hellos received.
        boots: Number of hellos that show a reset or another board since the previous hello, also across reopenings of the
            port. Unlike ``counters.resets`` it needs no sample.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive") -> None:
        self.hellos = self.boots = 0
        self._previous_hello: Hello | None = None  # unlike _hello, never discarded
        self._state = np.zeros(1, dtype=DECODER)
        self._state["boot_id"] = -1
        self._state["current_sign"] = 1.0 if current_sign == "discharge_positive" else -1.0
        self._scaling = np.zeros(1, dtype=SCALING)
        self._samples = np.zeros(256, dtype=SAMPLE)
        self._messages = np.zeros((_MAX_MESSAGES, PACKET_BYTES), dtype=np.uint8)
        self._hello: Hello | None = None
        self._acks: list[Ack] = []
        self._printable_bytes = 0
        # numba compiles both kernels now, before bytes arrive
        self._decode(np.empty(0), np.empty(0, dtype=np.int64), np.frombuffer(b"", dtype=np.uint8), 0, 0)
        clock_ppm(self._state[0])

    @property
    def hello(self) -> Hello | None:
        """Last hello of the board.

        None before the first one, after a reset without a hello, and while another board may be connected.
        """
        return self._hello if self._state["boot_id"][0] >= 0 else None

    @property
    def board(self) -> Mapping[str, str]:
        """Description of the board; empty before its hello."""
        hello = self.hello
        if hello is None:
            return {}
        return {
            "firmware": hello.firmware,
            "serial": _hexadecimal(hello.serial),
            "sample_rate_hz": str(hello.rate_hz),
            "divider": f"{hello.divider_ppm * 1e-6:g}",
            "volts_per_ampere": f"{hello.current_uv_per_a * 1e-6:g}",
            "ratiometric": str(hello.channels >> 1 & 1),
            "current_zero": f"{hello.current_zero_ppm * 1e-6:g}",
            "bandgap_v": f"{hello.bandgap_uv * 1e-6:g}",
        }

    @property
    def reference_v(self) -> float:
        """Full range of the board's converter [V]; NaN before it is known."""
        return float(reference(self._scaling[0]))

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the board's clock relative to the arrival times, rounded to 0.1 [1e-6].

        None during the first minute, and if implausible. It does not change the samples' times.
        """
        ppm = clock_ppm(self._state[0])
        return round(ppm, 1) if abs(ppm) < MAX_CLOCK_PPM else None  # NaN compares false

    @property
    def counters(self) -> FrameCounters:
        """Counts since start."""
        counts = self._state[_COUNTERS].item()
        return FrameCounters(**dict(zip(_COUNTERS, counts, strict=True)))

    @property
    def last_frame_end(self) -> int:
        """``bytes_received`` at the end of the last frame with a right CRC."""
        return int(self._state["last_frame_end"][0])

    @property
    def fault(self) -> FrameFault | None:
        """Fault of the line as a whole; None while frames arrive."""
        state = self._state[0]
        if state["bytes_received"] - state["last_frame_end"] > MAX_BYTES_WITHOUT_FRAME:
            return FrameFault.TEXT if self._printable_bytes > MAX_BYTES_WITHOUT_FRAME else FrameFault.WRONG_BAUD
        if state["frames_received"] == 0 and state["version_errors"] > 0:
            return FrameFault.NEWER_PROTOCOL
        if state["frames_received"] == 0 and state["before_hello"] > 0:
            return FrameFault.NO_HELLO
        return None

    def serial_number_in(self, data: bytes) -> str | None:
        """Return the serial number of the last hello in ``data`` without feeding it; empty if the board has none."""
        state, serial = self._state[0], None
        buffered = state["buffer"][: state["length"]].tobytes()
        for frame in (buffered + data).split(DELIMITER)[:-1]:
            if len(frame) == HELLO_FRAME_BYTES:
                with contextlib.suppress(ProtocolError):
                    serial = _hexadecimal(Hello.decode(unseal(frame)).serial)
        return serial

    def discard_hello(self) -> None:
        """Discard the hello. Samples use its scaling until the next one."""
        self._hello = None

    def pop_acks(self) -> list[Ack]:
        """Return the acknowledgments received since the last call."""
        acks, self._acks = self._acks, []
        return acks

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read.

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            data: Received bytes.

        Returns:
            Samples, shape (n,), n may be 0. ``time_s`` is the unwrapped board clock since the first sample. Across a reset
            of the board it continues by the arrival time.
        """
        block = self.feed_reads(np.array([arrival_s]), np.array([len(data)]), np.frombuffer(data, dtype=np.uint8))
        if self._state["last_frame_end"][0] + MAX_BYTES_WITHOUT_FRAME < self._state["bytes_received"][0]:
            self._printable_bytes = self._printable_bytes + len(data) if is_text(data) else 0
        return block

    def feed_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads at once. The samples are those that ``feed`` would return for each read.

        Args:
            arrivals_s: Shape (reads,): arrival time of each read [s].
            ends: Shape (reads,): end of each read in ``data``.
            data: Concatenated bytes of the reads.

        Returns:
            Samples of all reads, as from ``feed``.
        """
        max_samples = data.size // SAMPLE_FRAME_BYTES + 2
        if self._samples.size < max_samples:
            self._samples = np.zeros(max_samples, dtype=SAMPLE)
        position = count = 0
        while position < data.size:
            position, samples, messages = self._decode(arrivals_s, ends, data, position, count)
            count += samples
            for packet in self._messages[:messages]:
                self._store_message(packet)
        return self._samples[:count].copy()

    def _decode(
        self,
        arrivals_s: NDArray[np.float64],
        ends: NDArray[np.int64],
        data: NDArray[np.uint8],
        position: int,
        count: int,
    ) -> tuple[int, int, int]:
        """Call ``framing.decode`` from ``position`` on; append to the first ``count`` samples."""
        out = self._samples[count:]
        return decode(data, position, ends, arrivals_s, self._state, self._scaling, out, self._messages)

    def _store_message(self, packet: NDArray[np.uint8]) -> None:
        """Decode and store a hello or an acknowledgment.

        Args:
            packet: Version, type and body, padded with zeros.
        """
        message_type, ack_result = packet[1], packet[3]
        if message_type == MessageType.HELLO:
            hello = Hello.decode(packet[: 2 + Hello.LAYOUT.size].tobytes())
            self.hellos += 1
            self.boots += self._previous_hello is not None and _is_other_boot(self._previous_hello, hello)
            self._hello = self._previous_hello = hello
        elif ack_result in _ACK_RESULTS:
            self._acks.append(Ack.decode(packet[: 2 + Ack.LAYOUT.size].tobytes()))
            del self._acks[:-_MAX_MESSAGES]


def _is_other_boot(previous: Hello, hello: Hello) -> bool:
    """Return True if the board was reset or exchanged between two hellos."""
    is_same_board = (hello.boot_id, hello.serial) == (previous.boot_id, previous.serial)
    # a lower sequence number also shows a restart, because two boards may have equal boot ids, and no serial number
    has_restarted = (hello.sequence - previous.sequence) % MODULUS >= MODULUS // 2
    return not is_same_board or has_restarted


def _hexadecimal(serial: int) -> str:
    return f"{serial:08x}" if serial else ""


_ACK_RESULTS = frozenset(AckResult)
_COUNTERS = [field.name for field in fields(FrameCounters) if field.name in (DECODER.names or ())]


def is_text(data: bytes) -> bool:
    """Return True if bytes could be printed lines."""
    return not data.translate(None, PRINTABLE)
