"""Boards that print text: ``protocols.base.reading`` defines the lines."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.model.sample import (
    MAX_C,
    MAX_CELL_V,
    MIN_C,
    MIN_CELL_V,
    SAMPLE,
    CurrentSign,
    SampleBlock,
    remove_implausible,
)
from bms_estimator.protocols.base.device import Device, Resolution
from bms_estimator.protocols.base.device_clock import DeviceClock
from bms_estimator.protocols.base.device_protocol import DeviceProtocol, cell_block
from bms_estimator.protocols.base.reading import Reading, read_line

LINE_BYTES = 4096
"""A longer line is noise: 400 cells of seven characters fit."""
SHOWN_BYTES = 60
"""Maximum number of characters of an invalid line that are shown."""


class TextProtocol(DeviceProtocol):
    """Lines of a board to samples. It takes no commands.

    Lines without values are counted and skipped. Lines without ``time_s`` divide the time since the previous read
    evenly. How the bytes are cut into reads changes no value but these times.

    Args:
        current_sign: What the board calls positive; samples are positive on discharge.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive") -> None:
        self._sign = 1.0 if current_sign == "discharge_positive" else -1.0
        self._rest = b""
        self._overlong = False  # the line is too long, its rest is skipped
        self._in_step = False  # True once a line has ended, because earlier bytes may be half a line
        self._clock, self._last_s = DeviceClock(), math.nan
        self._bytes = self._samples = self._errors = self._too_long = self._implausible = 0
        self._bad: bytes | None = None  # the first line without values since the last good one
        self._good: Reading | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """Samples and faults since start."""
        return {
            "bytes_received": self._bytes,
            "frames_received": self._samples,
            "text_errors": self._errors,
            "length_errors": self._too_long,
            "implausible": self._implausible,
            "clock_jumps": self._clock.jumps,
        }

    @property
    def fault(self) -> str | None:
        """The first line without values, unchanged."""
        if self._bad is None:
            return None
        shown = repr(self._bad[:SHOWN_BYTES])[1:] + ("..." if len(self._bad) > SHOWN_BYTES else "")
        if 4 * len(self._bad.translate(None, PRINTABLE)) > len(self._bad):
            return (
                f"bytes that are no text come: wrong baud rate, or sensor.protocol should be binary? They begin {shown}"
            )
        return f"lines come that do not tell voltage and current; the first: {shown}"

    @property
    def description(self) -> str | None:
        """The last line's values, once it was a whole one."""
        if self._good is None:
            return None
        return f"prints text, {self._good.voltage_v:g} V, {self._good.current_a:g} A"

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode one read of the line; ``time_s`` is since the first sample, as ``DeviceClock`` has it."""
        self._bytes += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        readings = [reading for line in lines if (reading := self._end_line(line)) is not None]
        if self._overlong:
            self._rest = b""
        elif len(self._rest) > LINE_BYTES:
            self._begin_overlong(self._rest)
            self._rest, self._overlong = b"", True
        self.cells = cell_block([reading.cells_v for reading in readings])
        self._implausible += remove_implausible(self.cells, MIN_CELL_V, MAX_CELL_V)
        block = np.empty(len(readings), dtype=SAMPLE)
        if readings:
            self._samples += len(readings)
            block["voltage_v"] = [reading.voltage_v for reading in readings]
            block["current_a"] = [self._sign * reading.current_a for reading in readings]
            block["temperature_c"] = [reading.temperature_c for reading in readings]
            self._implausible += remove_implausible(block["temperature_c"], MIN_C, MAX_C)
            block["status"] = 0
            block["time_s"] = self._times(arrival_s, readings)
        return block

    def _times(self, arrival_s: float, readings: Sequence[Reading]) -> list[float]:
        """Return times of samples that arrived together [s]."""
        before_s, self._last_s = (arrival_s if math.isnan(self._last_s) else self._last_s), arrival_s
        steps = np.arange(1, len(readings) + 1) / len(readings)
        arrivals = (before_s + (arrival_s - before_s) * steps).tolist()
        return [self._clock.sample_time(at_s, reading.time_s) for at_s, reading in zip(arrivals, readings, strict=True)]

    def _end_line(self, line: bytes) -> Reading | None:
        """Parse a line. A partial first line is not counted as a fault."""
        counted, self._in_step = self._in_step, True
        if self._overlong:  # the end of it
            self._overlong = False
            return None
        if len(line) > LINE_BYTES:
            self._begin_overlong(line)
            return None
        reading = read_line(line)
        if reading is not None:
            self._bad = None
            self._good = reading if counted else None
        elif counted and line.strip():
            self._errors += 1
            self._bad = self._bad or line.rstrip(b"\r")
        return reading

    def _begin_overlong(self, line: bytes) -> None:
        self._too_long += 1
        self._bad = self._bad or line[:LINE_BYTES]


DEVICE = Device(
    "text",
    lambda sign, _: TextProtocol(current_sign=sign),
    Resolution(period_s=1.0),
)
"""Boards print at their own pace, usually once a second."""
