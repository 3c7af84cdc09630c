"""Plain text boards: ``voltage,current[,temperature]`` lines, as every hobby sketch prints them."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.sources.frames import DEAF_BYTES, CurrentSign, FrameCounters, FrameFault, is_text
from bms_estimator.sources.protocol import Ack, Hello

LINE_BYTES = 256
"""A longer line is noise."""
_SEPARATORS = bytes.maketrans(b",;\t", b"   ")


class TextDecoder:
    """Lines of a board to samples; the same interface as ``FrameDecoder``.

    A line holds volts, amperes and, if it likes, degrees Celsius, set apart by comma, semicolon, tab or blanks. Other
    lines are counted and skipped. Lines carry no clock: those of one read share the time since the read before evenly.

    Args:
        current_sign: What the board calls positive; samples are positive on discharge.
    """

    hello: Hello | None = None
    """Text has none."""
    clock_ppm: float | None = None
    """Lines carry no clock."""

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive") -> None:
        self._sign = 1.0 if current_sign == "discharge_positive" else -1.0
        self._rest = b""
        self._in_step = False
        self._first_s = self._last_s = float("nan")
        self._bytes = self._heard_at = self._samples = self._errors = self._too_long = 0
        self._binary = False

    @property
    def board(self) -> Mapping[str, str]:
        """Text boards say nothing of themselves."""
        return {}

    @property
    def counters(self) -> FrameCounters:
        """Since start."""
        return FrameCounters(
            bytes_received=self._bytes,
            frames_received=self._samples,
            text_errors=self._errors,
            length_errors=self._too_long,
        )

    @property
    def fault(self) -> FrameFault | None:
        """What is wrong with the line as a whole; None while samples come."""
        if self._bytes - self._heard_at > DEAF_BYTES:
            return FrameFault.BINARY if self._binary else FrameFault.WRONG_BAUD
        return None

    def forget_hello(self) -> None:
        """Text has none."""

    def take_acks(self) -> list[Ack]:
        """Text boards take no commands."""
        return []

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode one read of the line.

        Args:
            arrival_s: When it came, on any clock that never steps back [s].
            data: What came.

        Returns:
            Samples, shape (n,), n may be 0; ``time_s`` since the first by arrival.
        """
        self._bytes += len(data)
        self._binary = not is_text(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LINE_BYTES:
            self._rest, self._in_step = b"", False
            self._too_long += 1
        rows = [row for line in lines if (row := self._read_line(line)) is not None]
        block = np.empty(len(rows), dtype=SAMPLE)
        if rows:
            self._heard_at = self._bytes
            self._samples += len(rows)
            values = np.array(rows)
            block["voltage_v"], block["current_a"], block["temperature_c"] = values.T
            block["current_a"] *= self._sign
            block["status"] = 0
            block["time_s"] = self._times(arrival_s, len(rows))
        return block

    def feed_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads of the line: ``feed`` for each (see ``FrameDecoder.feed_reads``)."""
        blocks = [np.empty(0, dtype=SAMPLE)]
        begin = 0
        for arrival_s, end in zip(arrivals_s.tolist(), ends.tolist(), strict=True):
            blocks.append(self.feed(arrival_s, data[begin:end].tobytes()))
            begin = end
        return np.concatenate(blocks)

    def _times(self, arrival_s: float, count: int) -> NDArray[np.float64]:
        """Times of ``count`` samples that came together, evenly over the time since those before [s]."""
        if self._samples == count:
            self._first_s = self._last_s = arrival_s
            return np.zeros(count)
        steps = np.arange(1, count + 1) / count
        times = self._last_s + (arrival_s - self._last_s) * steps - self._first_s
        self._last_s = arrival_s
        return times

    def _read_line(self, line: bytes) -> tuple[float, float, float] | None:
        """Volts, amperes, degrees of a line; None for any other. Half a line at the start is no fault."""
        counted, self._in_step = self._in_step, True
        parts = line.translate(_SEPARATORS).split()
        if not parts and len(line) <= LINE_BYTES:
            return None
        try:
            if len(parts) == 2:
                return float(parts[0]), float(parts[1]), float("nan")
            if len(parts) == 3:
                return float(parts[0]), float(parts[1]), float(parts[2])
        except ValueError:
            pass
        self._errors += counted
        return None
