"""Protocol of boards that print text lines, in the formats of ``protocols.base.reading``."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bms_estimator.model.arrays import (
    MAX_CELL_V,
    MIN_CELL_V,
    SAMPLE,
    CurrentSign,
    SampleBlock,
    SampleStatus,
    remove_implausible,
)
from bms_estimator.model.decimal_text import PRINTABLE
from bms_estimator.protocols.base.device_clock import DeviceClock
from bms_estimator.protocols.base.polled_protocol import Device, SensorDefaults
from bms_estimator.protocols.base.probe_check import ProbeCheck
from bms_estimator.protocols.base.reading import Reading, read_line
from bms_estimator.protocols.base.reading_protocol import DeviceProtocol, cell_block

MAX_LINE_BYTES = 4096
"""Maximum length of a line [bytes]: 400 cells of seven characters fit. A longer line is noise."""
MAX_UNPRINTABLE_FRACTION = 0.25
"""Maximum fraction of unprintable bytes in a line. More shows binary data or a wrong baud rate."""
MAX_SHOWN_BYTES = 60
"""Maximum number of characters of an invalid line that are shown."""


class TextProtocol(DeviceProtocol):
    """Protocol of a board that prints lines. It takes no commands.

    Lines without values are counted and skipped. Lines without ``time_s`` are spaced evenly over the time since the
    previous read. Apart from these times, the result does not depend on how the bytes are split into reads.

    Args:
        current_sign: Direction of positive current of the board; samples are positive on discharge.
    """

    def __init__(self, *, current_sign: CurrentSign = "discharge_positive") -> None:
        self._sign = 1.0 if current_sign == "discharge_positive" else -1.0
        self._unparsed = b""
        self._overlong = False  # True while the rest of a line that is too long is skipped
        self._synchronized = False  # True once a line has ended, because earlier bytes may be half a line
        self._clock, self._last_s = DeviceClock(), math.nan
        self._received_bytes = self._samples = self._invalid_lines = self._overlong_lines = 0
        self._implausible = self._implausible_cells = 0
        self._first_invalid: bytes | None = None  # the first line without values since the last good one
        self._last_reading: Reading | None = None
        self._probe_check = ProbeCheck()

    @property
    def counters(self) -> Mapping[str, int]:
        """Samples and faults since start."""
        return {
            "bytes_received": self._received_bytes,
            "frames_received": self._samples,
            "text_errors": self._invalid_lines,
            "length_errors": self._overlong_lines,
            "implausible": self._implausible + self._probe_check.faults,
            "implausible_cells": self._implausible_cells,
            "clock_jumps": self._clock.jumps,
        }

    @property
    def fault(self) -> str | None:
        """Fault with the first invalid line since the last reading; None without one."""
        if self._first_invalid is None:
            return None
        shown = repr(self._first_invalid[:MAX_SHOWN_BYTES])[1:] + (
            "..." if len(self._first_invalid) > MAX_SHOWN_BYTES else ""
        )
        unprintable_bytes = len(self._first_invalid.translate(None, PRINTABLE))
        if unprintable_bytes > MAX_UNPRINTABLE_FRACTION * len(self._first_invalid):
            return (
                "the received bytes are not text: wrong baud rate, or should sensor.protocol be binary? "
                f"They begin {shown}"
            )
        return f"lines without voltage and current arrive; the first: {shown}"

    @property
    def description(self) -> str | None:
        """Values of the last line; None before a complete line."""
        if self._last_reading is None:
            return None
        return f"prints text, {self._last_reading.voltage_v:g} V, {self._last_reading.current_a:g} A"

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the times in the lines, which are then not used; empty without one."""
        return self._clock.fault

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read; ``time_s`` is the time since the first sample, from ``DeviceClock``."""
        self._received_bytes += len(data)
        *lines, self._unparsed = (self._unparsed + data).split(b"\n")
        readings = [reading for line in lines if (reading := self._end_line(line)) is not None]
        if self._overlong:
            self._unparsed = b""
        elif len(self._unparsed) > MAX_LINE_BYTES:
            self._begin_overlong(self._unparsed)
            self._unparsed, self._overlong = b"", True
        self._store_device_values(readings)
        self.cells = cell_block([reading.cells_v for reading in readings])
        self._implausible_cells += remove_implausible(self.cells, MIN_CELL_V, MAX_CELL_V)
        block = np.empty(len(readings), dtype=SAMPLE)
        if readings:
            self._samples += len(readings)
            block["voltage_v"] = [reading.voltage_v for reading in readings]
            block["current_a"] = [self._sign * reading.current_a for reading in readings]
            block["time_s"], clock_status = self._times(arrival_s, readings)
            block["status"] = [_status(reading) for reading in readings]
            block["status"] |= np.array(clock_status, np.uint32)
        self.probes = self._probe_check.apply(block, [reading.temperatures_c for reading in readings])
        return block

    def _times(self, arrival_s: float, readings: Sequence[Reading]) -> tuple[list[float], list[int]]:
        """Return the times of samples that arrived together [s], and ``WRONG_CLOCK`` or 0 for each."""
        before_s, self._last_s = (arrival_s if math.isnan(self._last_s) else self._last_s), arrival_s
        steps = np.arange(1, len(readings) + 1) / len(readings)
        arrivals = (before_s + (arrival_s - before_s) * steps).tolist()
        times_s, status = [], []
        for at_s, reading in zip(arrivals, readings, strict=True):
            times_s.append(self._clock.sample_time(at_s, reading.time_s))
            status.append(SampleStatus.WRONG_CLOCK if self._clock.fault else 0)
        return times_s, status

    def _end_line(self, line: bytes) -> Reading | None:
        """Parse a line. The first line may be partial; it is not counted as a fault and does not describe the device."""
        is_complete, self._synchronized = self._synchronized, True
        if self._overlong:  # this is the end of the overlong line
            self._overlong = False
            return None
        if len(line) > MAX_LINE_BYTES:
            self._begin_overlong(line)
            return None
        reading = read_line(line)
        if reading is not None:
            self._first_invalid = None
            self._last_reading = reading if is_complete else None
        elif is_complete and line.strip():
            self._invalid_lines += 1
            self._first_invalid = self._first_invalid or line.rstrip(b"\r")
        return reading

    def _begin_overlong(self, line: bytes) -> None:
        self._overlong_lines += 1
        self._first_invalid = self._first_invalid or line[:MAX_LINE_BYTES]


def _status(reading: Reading) -> int:
    """Return the bits of ``SampleStatus`` of a reading."""
    voltage_bit = SampleStatus.VOLTAGE_HELD if reading.voltage_held else 0
    return voltage_bit | (SampleStatus.CURRENT_HELD if reading.current_held else 0)


DEVICE = Device(
    "text",
    lambda sensor: TextProtocol(current_sign=sensor.current_sign),
    SensorDefaults(period_s=1.0),
)
"""Boards print at their own pace, usually once a second."""
