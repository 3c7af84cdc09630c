"""True SOC of a simulated pack at the last received sample."""

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
"""Number of the board's last bytes that are stored, enough to contain a complete sample frame."""


class PackWithSocHistory:
    """Simulated pack that a board measures, and that stores the SOC at each sample.

    It also reads the board's bytes: the board's clock in the last frame determines which sample the host has received.

    Args:
        pack: Simulated pack. The board may read it before the samples arrive at the host. Therefore past SOCs are
            stored.
    """

    missed_reads = 0
    """Number of reads that the tap missed, which is always 0."""

    def __init__(self, pack: SimulatedPack) -> None:
        self._pack = pack
        self._soc_history: deque[tuple[float, float]] = deque([(0.0, pack.soc)])
        self._tail = b""
        self._board_us = 0

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the pack's terminals at ``time_s`` [s]."""
        reading = self._pack(time_s)
        self._soc_history.append((time_s, self._pack.soc))
        return reading

    def write(self, _arrival_s: float, data: bytes) -> None:
        """Store the last bytes of the board's line."""
        self._tail = (self._tail + data)[-TAIL_BYTES:]

    def soc(self) -> float:
        """Return the pack's SOC, 0..1, at the last received sample; the initial SOC before the first one."""
        for frame in reversed(self._tail.split(DELIMITER)[:-1]):
            if (board_us := _board_us(frame)) is not None:
                self._board_us += (board_us - self._board_us) % MODULUS  # the clock in a frame rolls over
                break
        while len(self._soc_history) > 1 and self._soc_history[1][0] <= 1e-6 * self._board_us:
            self._soc_history.popleft()
        return self._soc_history[0][1]


def _board_us(frame: bytes) -> int | None:
    """Return the board's clock in a sample frame [us]; None for another frame."""
    try:
        packet = unseal(frame)
    except ProtocolError:
        return None
    return SampleMessage.decode(packet).board_us if packet[1] == MessageType.SAMPLE else None
