"""Simulated BMS that responds to requests on a pseudo-terminal, with optional faults."""

import math
import random
from collections import deque
from collections.abc import Callable
from enum import Enum

from bms_estimator.simulation.bms_responses import BMS_RESPONSES, MAX_CELLS, Measured
from bms_estimator.simulation.simulated_meter import Signal, SimulatedMeter
from bms_estimator.simulation.virtual_adc import Reading

MAX_REQUEST_BYTES = 64
"""Maximum length of a request [bytes]."""
CUT_BYTES = 5
"""Number of bytes that a truncated response lacks."""
NOISE_BYTES = 20
"""Number of random bytes before a response with noise."""
MAX_CELL_DEVIATION_V = 0.004
"""Maximum deviation of a cell from the mean [V]."""


class BmsFault(Enum):
    """Fault of a response; the value describes the response."""

    SILENCE = "never sent"
    CORRUPT = "one byte changed"
    SHORT = "its last bytes missing"
    NOISE = "noise before it"


class SimulatedBms(SimulatedMeter):
    """Simulated BMS on a pseudo-terminal.

    Args:
        protocol: A key of ``BMS_RESPONSES``.
        signal: Readings of the simulated pack as a function of time [s].
        cells: Number of cells in series.
        speed: Speed relative to real time.
        soc: Returns the SOC that the BMS reports, 0..1.
        capacity_ah: Capacity that the BMS reports [Ah].
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
        self._responses, self._soc, self._capacity_ah = BMS_RESPONSES[protocol], soc, capacity_ah
        self._random = random.Random(seed)
        deviations_v = [self._random.uniform(-MAX_CELL_DEVIATION_V, MAX_CELL_DEVIATION_V) for _ in range(cells)]
        self._deviations_v = [deviation_v - math.fsum(deviations_v) / cells for deviation_v in deviations_v]
        self._faults: deque[BmsFault] = deque()

    def inject(self, fault: BmsFault, responses: int = 1) -> None:
        """Apply ``fault`` to the next ``responses`` responses that have no fault yet."""
        self._faults.extend([fault] * responses)

    def clear_faults(self) -> None:
        """Discard the remaining faults."""
        self._faults.clear()

    def message(self, reading: Reading) -> bytes:  # noqa: ARG002 - interface
        """Return no bytes, because a BMS sends nothing unsolicited."""
        return b""

    def respond(self, received: bytes, reading: Reading) -> tuple[bytes, int]:
        """Respond to each request in ``received``, in order."""
        responses, end = b"", 0
        while first := min(
            ((at, request) for request in self._responses if (at := received.find(request, end)) >= 0), default=None
        ):
            at, request = first
            end = at + len(request)
            responses += self._with_fault(self._responses[request](self._measured(reading)))
        # the last bytes remain, because they may be the beginning of a request
        return responses, max(end, len(received) - MAX_REQUEST_BYTES)

    def _measured(self, reading: Reading) -> Measured:
        cell_v = reading.voltage_v / len(self._deviations_v)
        cells_v = [cell_v + deviation_v for deviation_v in self._deviations_v]
        return Measured(
            reading.voltage_v, reading.current_a, reading.temperature_c, cells_v, self._soc(), self._capacity_ah
        )

    def _with_fault(self, response: bytes) -> bytes:
        """Apply the next fault, if there is one, to a response."""
        match self._faults.popleft() if self._faults else None:
            case BmsFault.SILENCE:
                return b""
            case BmsFault.CORRUPT:
                at = len(response) // 2
                return response[:at] + bytes((response[at] ^ 0x55,)) + response[at + 1 :]
            case BmsFault.SHORT:
                return response[:-CUT_BYTES]
            case BmsFault.NOISE:
                return self._random.randbytes(NOISE_BYTES) + response
        return response
