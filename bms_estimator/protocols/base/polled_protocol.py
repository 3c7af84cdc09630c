"""Devices that respond to requests in frames with a checksum: common parts of ``jbd``, ``daly`` and ``jk``."""

import math
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from enum import Enum

from bms_estimator.model.sample import MAX_C, MIN_C, CurrentSign
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.reading_protocol import ReadingProtocol

PACE_S = 1.0
"""Poll interval [s], as in dbus-serialbattery."""
GAP_S = 0.22
"""Interval between two queries [s]: the longest response, 48 cells of a Daly at 9600 baud, takes this long on the
line."""
UNANSWERED_ROUNDS = 3
"""Number of unanswered poll cycles after which the next query variant is tried."""
NOISE_BYTES = 64
"""Number of bytes without a frame that counts as a fault and not as a single glitch."""
MAX_START = 4
"""No frame begins with more bytes that are always the same."""
FAULTS = ("crc_errors", "length_errors", "short_frames", "noise_bytes", "refused", "other_packs")
FRESH_S = 3.0
"""Values from a separate response are attached to a sample only if they are newer than this [s]."""


class ParseResult(Enum):
    """Result at a possible frame start with unknown length."""

    MORE = "its beginning has not come yet"
    NOISE = "no frame of this device"
    LENGTH = "a frame with a length that none has"


class PolledProtocol(ReadingProtocol):
    """Frames to samples, and the questions at their own pace. It takes no commands.

    Bytes outside frames are skipped one by one, so that the next complete frame is found; how the bytes are
    cut into reads changes no value but the times.

    Args:
        name: Name of the device, for people.
        start: What a frame begins with.
        current_sign: What the device calls positive; samples are positive on discharge.
        address: Address of the device on a shared line; None: the first that responds.
    """

    def __init__(
        self, name: str, start: re.Pattern[bytes], current_sign: CurrentSign, address: int | None = None
    ) -> None:
        super().__init__(current_sign, FAULTS)
        self._name, self._start, self._address = name, start, address
        self._rest = b""
        self._answers = 0  # good frames of any kind
        self._noise = 0  # bytes since the last of them
        self._due: list[bytes] = []
        self._asked = b""
        self._way = self._unanswered = 0
        self._answers_before = -1  # when the last round began; before the first nothing could be answered
        self._round_s = self._asked_s = -math.inf

    @property
    def fault(self) -> str | None:
        """First invalid response since the last sample."""
        if self._wrong is None and self._noise > NOISE_BYTES:
            return f"bytes come that are no answer of a {self._name}: wrong baud rate, or another sensor.protocol?"
        return self._wrong

    @abstractmethod
    def _query_variants(self) -> Sequence[Sequence[bytes]]:
        """Request variants, each with the requests of one poll cycle: the first that is answered is kept."""

    @abstractmethod
    def _frame_length(self, data: bytes, at: int) -> int | ParseResult:
        """Length of the frame that begins at ``at`` with ``start``, checksum and all [bytes]."""

    @abstractmethod
    def _is_whole(self, frame: bytes) -> bool:
        """Return True if its checksum is right."""

    @abstractmethod
    def _decode_frame(self, arrival_s: float, frame: bytes) -> Reading | None:
        """Decode a whole frame; None if it is not a sample."""

    def on_port_opened(self) -> None:
        """Poll at once, with the first variant.

        Decoded values stay, because a recording does not contain openings.
        """
        self._due, self._way, self._unanswered, self._answers_before = [], 0, 0, -1
        self._round_s = self._asked_s = -math.inf

    def next_output(self, now_s: float) -> bytes:
        """Return the next query of the poll cycle; nothing while the device has time to respond."""
        if now_s - self._asked_s < GAP_S:
            return b""
        if not self._due:
            if now_s - self._round_s < PACE_S:
                return b""
            self._begin_round(now_s)
        self._asked_s, self._asked = now_s, self._due.pop(0)
        return self._asked

    def _begin_round(self, now_s: float) -> None:
        on_time = now_s - self._round_s < 2.0 * PACE_S
        self._round_s = self._round_s + PACE_S if on_time else now_s  # asked a little late, it keeps its period
        self._unanswered = self._unanswered + 1 if self._answers == self._answers_before else 0
        self._answers_before = self._answers
        if self._unanswered > UNANSWERED_ROUNDS:
            self._way, self._unanswered = self._way + 1, 0
        ways = self._query_variants()
        self._due = list(ways[self._way % len(ways)])

    def _read(self, arrival_s: float, data: bytes) -> Iterator[Reading]:
        for frame in self._frames(data):
            self._answers += 1
            self._noise = 0
            if (reading := self._decode_frame(arrival_s, frame)) is not None:
                yield reading

    def _frames(self, data: bytes) -> list[bytes]:
        """Whole frames that end in ``data``; an incomplete frame is kept."""
        rest = self._rest + data
        frames, done, waiting = list[bytes](), 0, -1  # all before ``done`` is over, at ``waiting`` a frame has begun
        at = self._next(rest, 0)
        while at >= 0:
            look = self._frame_length(rest, at)
            if isinstance(look, int) and at + look > len(rest):
                look = ParseResult.MORE
            if isinstance(look, int) and self._is_whole(rest[at : at + look]):
                if waiting >= 0:
                    self._count_fault(
                        "short_frames", "an answer broke off: interference, or a second master on the line?"
                    )
                self._skip(at - done)
                done, waiting = at + look, -1
                frames.append(rest[at:done])
                at = self._next(rest, done)
                continue
            if waiting < 0:  # otherwise it is checked again when the frame that began before it has ended
                if look is ParseResult.MORE:
                    waiting = at
                elif look is ParseResult.LENGTH:
                    self._count_fault(
                        "length_errors", "answers come with impossible lengths: interference, or a wrong baud rate?"
                    )
                elif look is not ParseResult.NOISE:
                    self._count_fault(
                        "crc_errors", "answers come with wrong checksums: interference, or a second master on the line?"
                    )
            at = self._next(rest, at + 1)
        keep = waiting if waiting >= 0 else max(done, len(rest) - MAX_START + 1)
        self._skip(keep - done)
        self._rest = rest[keep:]
        return frames

    def _next(self, data: bytes, at: int) -> int:
        """Return the position of the next possible frame start; -1 without one."""
        found = self._start.search(data, at)
        return found.start() if found else -1

    def _skip(self, count: int) -> None:
        """Skip bytes outside of frames."""
        self._counts["noise_bytes"] += count
        self._noise += count

    def _is_other(self, address: int) -> bool:
        """Return True if a response is from another pack.

        Without a configured address the first response selects the pack.
        """
        if self._address is None:
            self._address = address
        if address == self._address:
            return False
        self._count_fault(
            "other_packs", f"pack {address} answers, and pack {self._address} is wanted: see sensor.address"
        )
        return True

    def _mean_c(self, probes_c: Sequence[float]) -> float:
        """Return the pack's mean temperature from its probes [C]; an absent or broken probe reads beyond a pack's range."""
        there = [probe_c for probe_c in probes_c if MIN_C <= probe_c <= MAX_C]
        self._counts["implausible"] += len(probes_c) - len(there)
        return sum(there) / len(there) if there else math.nan
