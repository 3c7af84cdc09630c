"""Base class of protocols whose devices report complete readings."""

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.sample import (
    MAX_CELL_V,
    MIN_CELL_V,
    SAMPLE,
    CurrentSign,
    SampleBlock,
    remove_implausible,
)
from bms_estimator.protocols.base.device_protocol import DeviceProtocol, cell_block
from bms_estimator.protocols.base.probe_check import ProbeCheck
from bms_estimator.protocols.base.reading import Reading

ECHO_FAULT = (
    "the own requests come back, and no response arrives: the adapter echoes; "
    "are the device and its wires connected, and A and B or RX and TX not swapped?"
)
"""Fault of a line on which only own requests arrive."""


class ReadingProtocol(DeviceProtocol):
    """Protocol that decodes bytes to readings, and readings to samples. It takes no commands.

    Readings have no timestamps. The readings of one read are spaced evenly over the time since the previous read.

    Args:
        current_sign: Direction of positive current of the device; samples are positive on discharge.
        faults: Names of the fault counters.

    Attributes:
        last_reading: Last decoded reading; None before the first one.
    """

    def __init__(self, current_sign: CurrentSign, faults: Iterable[str]) -> None:
        self._sign = 1.0 if current_sign == "discharge_positive" else -1.0
        self._counts = dict.fromkeys(
            ("bytes_received", "frames_received", *faults, "implausible", "implausible_cells"), 0
        )
        self._first_s = self._last_s = math.nan
        self._fault_text: str | None = None
        self.last_reading: Reading | None = None
        self._probe_check = ProbeCheck()

    @property
    def counters(self) -> Mapping[str, int]:
        """Samples and faults since start."""
        return self._counts | {"implausible": self._counts["implausible"] + self._probe_check.faults}

    @property
    def fault(self) -> str | None:
        """First fault since the last reading; None without one."""
        return self._fault_text

    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read; ``time_s`` is the arrival time since the first sample."""
        self._counts["bytes_received"] += len(data)
        readings = []
        for reading in self._read(arrival_s, data):
            readings.append(reading)
            self.last_reading, self._fault_text = reading, None
        self._store_device_values(readings)
        self.cells = cell_block([reading.cells_v for reading in readings])
        self._counts["implausible_cells"] += remove_implausible(self.cells, MIN_CELL_V, MAX_CELL_V)
        block = np.empty(len(readings), dtype=SAMPLE)
        if readings:
            self._counts["frames_received"] += len(readings)
            block["voltage_v"] = [reading.voltage_v for reading in readings]
            block["current_a"] = [self._sign * reading.current_a + 0.0 for reading in readings]  # no -0
            block["status"] = 0
            block["time_s"] = self._spaced_times(arrival_s, len(readings))
        self.probes = self._probe_check.apply(block, [reading.temperatures_c for reading in readings])
        return block

    @abstractmethod
    def _read(self, arrival_s: float, data: bytes) -> Iterable[Reading]:
        """Decode the bytes of one read. Subclasses report faults with ``_count_fault``."""

    def _count_fault(self, counter: str, text: str) -> None:
        """Count a fault. The first one since the last reading is reported by ``fault``."""
        self._counts[counter] += 1
        self._fault_text = self._fault_text or text

    def _spaced_times(self, arrival_s: float, count: int) -> NDArray[np.float64]:
        """Return evenly spaced times of ``count`` samples that arrived together [s]."""
        if self._counts["frames_received"] == count:  # these are the first samples
            self._first_s = self._last_s = arrival_s
            return np.zeros(count)
        steps = np.arange(1, count + 1) / count
        times = self._last_s + (arrival_s - self._last_s) * steps - self._first_s
        self._last_s = arrival_s
        return times


class RecentCellVoltages:
    """Cell voltages from a separate response, for the next sample.

    Args:
        max_age_s: Maximum age of values that are attached to a sample [s].
    """

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s = max_age_s
        self._arrival_s, self._cells_v = -math.inf, tuple[float, ...]()

    def store(self, arrival_s: float, cells_v: Sequence[float]) -> None:
        """Store received voltages."""
        self._arrival_s, self._cells_v = arrival_s, tuple(cells_v)

    def at(self, arrival_s: float) -> tuple[float, ...]:
        """Return the voltages for a sample that arrived at ``arrival_s`` [V]; empty without a recent response."""
        return self._cells_v if arrival_s - self._arrival_s < self._max_age_s else ()
