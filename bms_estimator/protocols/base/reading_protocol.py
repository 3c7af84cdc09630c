"""Base classes of protocols: of all devices, and of those that report complete readings."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.arrays import (
    MAX_CELL_V,
    MIN_CELL_V,
    NO_CELLS,
    NO_PROBES,
    NO_SOC,
    SAMPLE,
    CellBlock,
    CurrentSign,
    Floats,
    ProbeBlock,
    SampleBlock,
    remove_implausible,
)
from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.probe_check import ProbeCheck, probe_block
from bms_estimator.protocols.base.reading import Reading
from bms_estimator.protocols.base.relay import Relay


class SensorCorrection(NamedTuple):
    """Gains of voltage and current, and the zero of the current."""

    voltage_gain: float = 1.0
    """True voltage / measured voltage."""
    current_gain: float = 1.0
    """True current / measured current without its zero."""
    current_zero_a: float = 0.0
    """Measured current while no current flows, positive on discharge [A]."""

    def apply(self, block: SampleBlock) -> SampleBlock:
        """Correct the samples of a block in place, and return the block. The default correction changes no bit."""
        if self != EXACT:
            block["voltage_v"] *= self.voltage_gain
            block["current_a"] = self.current_gain * (block["current_a"] - self.current_zero_a)
        return block


EXACT = SensorCorrection()
"""Correction of an exact sensor."""


@dataclass
class Command:
    """Command to a device. Its sender may set ``done`` to cancel it."""

    done: bool = False
    refusal: str | None = None
    """Reason why the device rejected the command; None if it did not."""


class DeviceProtocol(ABC):
    """Device protocol: decodes received bytes to samples, and encodes requests. It raises no error on invalid bytes.

    The samples depend only on the calls of ``feed``. A capture of these calls therefore replays bit-identically.
    """

    cells: CellBlock = NO_CELLS
    """Cell voltages of the samples that ``feed`` or ``feed_reads`` returned last [V]."""
    probes: ProbeBlock = NO_PROBES
    """Temperature probes of the last returned samples; empty if the device has a single one that is never faulty."""
    device_soc: Floats = NO_SOC
    """SOC that the device reports with the last returned samples, 0..1, NaN without one; ``NO_SOC`` if it reports none."""
    device_capacity_ah: float = math.nan
    """Capacity from which the device computes its SOC, as last reported [Ah]; NaN: not reported."""
    probing: bool = False
    """True while the device is unknown. Then ``next_output`` returns only queries that change nothing in any device."""
    correction: SensorCorrection = EXACT
    """Correction of the measured values."""

    @property
    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Counts since start: ``bytes_received``, ``frames_received`` (decoded samples), and faults by kind."""

    @property
    @abstractmethod
    def fault(self) -> str | None:
        """Fault of the line as a whole; None while samples arrive."""

    @property
    @abstractmethod
    def description(self) -> str | None:
        """Description of the device; None until it is known."""

    @property
    def board(self) -> Mapping[str, str]:
        """Properties that the device reported, such as its number ``serial``; empty before."""
        return {}

    @property
    def clock_ppm(self) -> float | None:
        """Rate error of the device's clock relative to the arrival times [1e-6]; None if unknown."""
        return None

    @property
    def clock_fault(self) -> str:
        """Description of a fault of the device's clock, whose times are then not used; empty without one."""
        return ""

    @property
    def allowed_silence_s(self) -> float:
        """Maximum time without data while the device works [s]."""
        return 0.0

    @property
    def boots(self) -> int:
        """Number of resets and exchanges of the device since start, as far as it reports them."""
        return 0

    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read, and correct the samples.

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            data: Received bytes.

        Returns:
            Samples, shape (n,), n may be 0.
        """
        return self.correction.apply(self._decode(arrival_s, data))

    def feed_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads at once. The samples are those that ``feed`` would return for each read.

        Args:
            arrivals_s: Arrival time of each read [s].
            ends: End of each read in ``data``.
            data: Concatenated bytes of the reads.
        """
        return self.correction.apply(self._decode_reads(arrivals_s, ends, data))

    @abstractmethod
    def _decode(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode the bytes of one read to samples as measured."""

    def _decode_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads at once to samples as measured."""
        blocks, cells = [np.empty(0, dtype=SAMPLE)], list[Sequence[float]]()
        probes, soc = list[Sequence[tuple[float, bool]]](), list[float]()
        begin = 0
        for arrival_s, end in zip(arrivals_s.tolist(), ends.tolist(), strict=True):
            blocks.append(self._decode(arrival_s, data[begin:end].tobytes()))
            cells += self.cells.tolist() or [()] * blocks[-1].size
            probes += self.probes.tolist() or [()] * blocks[-1].size
            soc += self.device_soc.tolist() or [math.nan] * blocks[-1].size
            begin = end
        self.cells, self.probes, self.device_soc = cell_block(cells), probe_block(probes), soc_block(soc)
        return np.concatenate(blocks)

    def _store_device_values(self, readings: Sequence[Reading]) -> None:
        """Store the SOC and the capacity that the device reports with the samples."""
        self.device_soc = soc_block([reading.soc if 0.0 <= reading.soc <= 1.0 else math.nan for reading in readings])
        for reading in readings:
            if reading.capacity_ah > 0.0:
                self.device_capacity_ah = reading.capacity_ah

    def serial_number_in(self, data: bytes) -> str | None:  # noqa: ARG002 - for subclasses
        """Return the serial number in ``data`` without decoding it; None if ``data`` contains none."""
        return None

    def on_port_opened(self) -> None:  # noqa: B027 - most subclasses have no state to reset
        """Reset after the port was opened. The next bytes may be from another device, or from a device that was reset."""

    def next_output(self, now_s: float) -> bytes:  # noqa: ARG002 - for subclasses
        """Return the bytes to send now. For a device that sends by itself, nothing is returned before it is recognized.

        Args:
            now_s: Present time on the clock of the arrival times [s].
        """
        return b""

    def command(self, name: str) -> Command:
        """Queue a command for ``next_output``, such as ``current_zero``.

        Raises:
            UserError: The device has no such command.
        """
        raise UserError(f"this device takes no commands: {name}")

    def relay(self, relay: Relay) -> Command:  # noqa: ARG002 - for subclasses
        """Queue the command that sets the level of the relay pin.

        Raises:
            UserError: The device has no relay pin.
        """
        raise UserError("this board has no relay pin")


def cell_block(rows: Sequence[Sequence[float]]) -> CellBlock:
    """Return the cell voltages of samples [V]. Rows with fewer cells are filled up with NaN."""
    cells = max(map(len, rows), default=0)
    if cells == 0:
        return NO_CELLS
    return np.array([[*row, *[math.nan] * (cells - len(row))] for row in rows])


def soc_block(soc: Sequence[float]) -> Floats:
    """Return the SOC of samples, NaN without a value; ``NO_SOC`` without any."""
    return NO_SOC if all(map(math.isnan, soc)) else np.array(soc)


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
