"""Base class of device protocols.

Bytes from a device to samples, and bytes that it is sent. It does not depend on a port.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.errors import UserError
from bms_estimator.model.sample import NO_CELLS, SAMPLE, CellBlock, SampleBlock
from bms_estimator.protocols.base.relay import Relay


@dataclass
class Command:
    """Command to a device. Its sender may set ``done`` to cancel it."""

    done: bool = False
    refusal: str | None = None
    """Why the device does not do it, for people."""


class DeviceProtocol(ABC):
    """Bytes with arrival times to samples, and the bytes that are to be sent. Does no I/O, and never raises on bytes.

    All that it yields follows from the calls of ``feed`` alone: a recording of them replays to the same bits.
    """

    cells: CellBlock = NO_CELLS
    """Beside the samples that ``feed`` or ``feed_reads`` returned last."""
    probing: bool = False
    """True while the device is unknown; ``next_output`` then sends only queries that change nothing in any device."""

    @property
    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Since start: ``bytes_received``, ``frames_received`` (samples handed on), and faults by kind."""

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
        """Hello of the device: ``serial`` if it has a serial number; empty before the hello."""
        return {}

    @property
    def clock_ppm(self) -> float | None:
        """Rate of the device's clock over that of arrivals [1e-6]; None if unknown."""
        return None

    @property
    def allowed_silence_s(self) -> float:
        """Maximum time without data of a working device [s]."""
        return 0.0

    @abstractmethod
    def feed(self, arrival_s: float, data: bytes) -> SampleBlock:
        """Decode one read of the line.

        Args:
            arrival_s: Arrival time, on any clock that never steps back [s].
            data: Received bytes.

        Returns:
            Samples, shape (n,), n may be 0.
        """

    def feed_reads(
        self, arrivals_s: NDArray[np.float64], ends: NDArray[np.int64], data: NDArray[np.uint8]
    ) -> SampleBlock:
        """Decode many reads of the line, as a ``CaptureBatch`` holds them: the same samples as ``feed`` for each."""
        blocks, cells = [np.empty(0, dtype=SAMPLE)], list[Sequence[float]]()
        begin = 0
        for arrival_s, end in zip(arrivals_s.tolist(), ends.tolist(), strict=True):
            blocks.append(self.feed(arrival_s, data[begin:end].tobytes()))
            cells += self.cells.tolist() or [()] * blocks[-1].size
            begin = end
        self.cells = cell_block(cells)
        return np.concatenate(blocks)

    def serial_number_in(self, data: bytes) -> str | None:  # noqa: ARG002 - for those that tell one
        """Return the serial number that the device would have at the end of ``data`` without feeding it; None without one."""
        return None

    def on_port_opened(self) -> None:  # noqa: B027 - most have nothing to forget
        """Reset after the port was opened: the next bytes may be another device's, or the same one's after a reset."""

    def next_output(self, now_s: float) -> bytes:  # noqa: ARG002 - for those that ask
        """Return the bytes to send now; nothing before a device that sends on its own was recognized.

        Args:
            now_s: On the clock of the arrivals [s].
        """
        return b""

    def command(self, name: str) -> Command:
        """Have ``next_output`` send what makes the device do ``name``, such as ``current_zero``.

        Raises:
            UserError: It takes no such command.
        """
        raise UserError(f"this board takes no commands, nor {name}")

    def relay(self, relay: Relay) -> Command:  # noqa: ARG002 - for those that have one
        """Have ``next_output`` send what sets the level of the relay pin.

        Raises:
            UserError: It does not exist.
        """
        raise UserError("this board has no relay pin")


def cell_block(rows: Sequence[Sequence[float]]) -> CellBlock:
    """Cell voltages of samples with different numbers of cells [V]."""
    cells = max(map(len, rows), default=0)
    if cells == 0:
        return NO_CELLS
    return np.array([[*row, *[math.nan] * (cells - len(row))] for row in rows])
