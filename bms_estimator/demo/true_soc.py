"""True SOC of a simulated pack at the sample that was decoded last."""

from collections import deque

from bms_estimator.protocols.firmware.messages import (
    DELIMITER,
    MODULUS,
    MessageType,
    ProtocolError,
    SampleMessage,
    unseal,
)
from bms_estimator.simulation.simulated_pack import SimulatedPack
from bms_estimator.simulation.virtual_adc import Reading

TAIL_BYTES = 256
"""The last bytes contain a complete sample frame among others."""


class TrueSoc:
    """A pack's signal for a board, and a tap on the board's line: the clock in a frame gives the time of the sample.

    Args:
        pack: Read at times that may run ahead of the board's, as a simulator reads from a pipe.
    """

    missed_reads = 0
    """Number of missed reads: always 0."""

    def __init__(self, pack: SimulatedPack) -> None:
        self._pack = pack
        self._ahead: deque[tuple[float, float]] = deque([(0.0, pack.soc)])
        self._tail = b""
        self._board_us = 0

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the pack's terminals at ``time_s`` [s]."""
        reading = self._pack(time_s)
        self._ahead.append((time_s, self._pack.soc))
        return reading

    def write(self, _arrival_s: float, data: bytes) -> None:
        """Take a read of the line."""
        self._tail = (self._tail + data)[-TAIL_BYTES:]

    def soc(self) -> float:
        """Return the pack's SOC, 0..1, at the last received sample; the initial SOC before the first one."""
        for frame in reversed(self._tail.split(DELIMITER)[:-1]):
            if (board_us := _board_us(frame)) is not None:
                self._board_us += (board_us - self._board_us) % MODULUS
                break
        while len(self._ahead) > 1 and self._ahead[1][0] <= 1e-6 * self._board_us:
            self._ahead.popleft()
        return self._ahead[0][1]


def _board_us(frame: bytes) -> int | None:
    """Return the board's clock in a sample frame [us]; None for another frame."""
    try:
        packet = unseal(frame)
    except ProtocolError:
        return None
    return SampleMessage.decode(packet).board_us if packet[1] == MessageType.SAMPLE else None
