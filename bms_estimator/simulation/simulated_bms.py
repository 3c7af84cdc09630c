"""A simulated BMS: responds to requests on a pseudo-terminal, with optional faults."""

import math
import random
from collections import deque
from collections.abc import Callable
from enum import Enum

from bms_estimator.simulation.bms_answers import BMS_ANSWERS, MAX_CELLS, Measured
from bms_estimator.simulation.simulated_meter import Signal, SimulatedMeter
from bms_estimator.simulation.virtual_adc import Reading

HEARD_BYTES = 64
"""No question is longer."""
MISSING_BYTES = 5
"""Length of a truncated response [bytes]."""
SPREAD_V = 0.004
"""Maximum deviation of a cell from the mean [V]."""


class BmsFault(Enum):
    """Fault of a response."""

    SILENCE = "never sent"
    CORRUPT = "one byte changed"
    SHORT = "its last bytes missing"
    NOISE = "noise before it"


class SimulatedBms(SimulatedMeter):
    """A BMS with some cells.

    Args:
        protocol: A key of ``BMS_ANSWERS``.
        signal: The simulated pack.
        cells: Number of cells in series.
        speed: Speed relative to real time.
        soc: SOC that it reports, 0..1.
        capacity_ah: Capacity that it reports.
        seed: Seed of the differences between the cells, and of noise.

    Raises:
        ValueError: No BMS of this protocol has that many cells.
    """

    def __init__(
        self,
        protocol: str,
        signal: Signal,
        *,
        cells: int,
        speed: float = 1.0,
        soc: Callable[[], float] = lambda: 0.5,
        capacity_ah: float = 100.0,
        seed: int = 0,
    ) -> None:
        if not 1 <= cells <= MAX_CELLS:
            raise ValueError(f"{cells} cells: a simulated BMS has 1 to {MAX_CELLS}")
        super().__init__(signal, speed=speed)
        self._answers, self._soc, self._capacity_ah = BMS_ANSWERS[protocol], soc, capacity_ah
        self._random = random.Random(seed)
        offsets_v = [self._random.uniform(-SPREAD_V, SPREAD_V) for _ in range(cells)]
        self._offsets_v = [offset_v - math.fsum(offsets_v) / cells for offset_v in offsets_v]
        self._faults: deque[BmsFault] = deque()

    def inject(self, fault: BmsFault, answers: int = 1) -> None:
        """Apply ``fault`` to the next ``answers`` responses without one."""
        self._faults.extend([fault] * answers)

    def mend(self) -> None:
        """Let nothing happen to answers any more."""
        self._faults.clear()

    def message(self, reading: Reading) -> bytes:  # noqa: ARG002 - as all of them
        """Nothing by itself."""
        return b""

    def answer(self, heard: bytes, reading: Reading) -> tuple[bytes, int]:
        """Respond to each query in ``heard``, in order."""
        said, end = b"", 0
        while found := min(
            ((at, question) for question in self._answers if (at := heard.find(question, end)) >= 0), default=None
        ):
            at, question = found
            end = at + len(question)
            said += self._spoiled(self._answers[question](self._measured(reading)))
        return said, max(end, len(heard) - HEARD_BYTES)

    def _measured(self, reading: Reading) -> Measured:
        cell_v = reading.voltage_v / len(self._offsets_v)
        cells_v = [cell_v + offset_v for offset_v in self._offsets_v]
        return Measured(
            reading.voltage_v, reading.current_a, reading.temperature_c, cells_v, self._soc(), self._capacity_ah
        )

    def _spoiled(self, answer: bytes) -> bytes:
        """Apply a fault to a response."""
        match self._faults.popleft() if self._faults else None:
            case BmsFault.SILENCE:
                return b""
            case BmsFault.CORRUPT:
                at = len(answer) // 2
                return answer[:at] + bytes((answer[at] ^ 0x55,)) + answer[at + 1 :]
            case BmsFault.SHORT:
                return answer[:-MISSING_BYTES]
            case BmsFault.NOISE:
                return self._random.randbytes(20) + answer
        return answer
