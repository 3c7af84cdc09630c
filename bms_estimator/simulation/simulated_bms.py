"""Simulated BMS that responds to requests on a pseudo-terminal, with optional faults; and the fuel cell stack behind it."""

import math
import random
from collections import deque
from collections.abc import Callable
from enum import Enum

import numpy as np

from bms_estimator.kernels.cell_model.fuel_cell import advance, load_file_constants, output, steady_state
from bms_estimator.kernels.observer.learning_records import LEARNABLE
from bms_estimator.model.pack_model import FuelCellModel
from bms_estimator.simulation.bms_responses import BMS_RESPONSES, MAX_CELLS, Measured
from bms_estimator.simulation.simulated_meter import Signal, SimulatedMeter
from bms_estimator.simulation.simulated_pack import Load
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


class SimulatedStack:
    """Simulated stack at the temperature of its file. Call the object with times that never decrease.

    A stack cannot be charged, so that negative currents of the load count as 0.

    Args:
        stack: Model of the stack.
        load: Load profile; the stack begins in its steady state under the first current.
    """

    def __init__(self, stack: FuelCellModel, load: Load) -> None:
        self._load, self._temperature_c = load, stack.fuel_cell.temperature_c
        self._remaining_s, load_a = next(load)
        self._current_a, self._time_s = max(load_a, 0.0), 0.0
        self._theta, self._file_constants = np.zeros(LEARNABLE), np.zeros(LEARNABLE)
        # the kernels also compute the derivatives by theta, which are not used
        self._x, self._dx, self._psi = np.zeros(2), np.zeros((2, LEARNABLE)), np.zeros(LEARNABLE)
        load_file_constants(self._file_constants, stack.a, self._temperature_c)
        steady_state(self._x, self._dx, self._theta, self._file_constants, self._current_a)

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the terminals at ``time_s`` [s]."""
        dt_s, self._time_s = time_s - self._time_s, time_s
        advance(self._x, self._dx, self._theta, self._file_constants, self._current_a, dt_s)
        self._remaining_s -= dt_s
        while self._remaining_s <= 0.0:
            seconds, load_a = next(self._load)
            self._current_a, self._remaining_s = max(load_a, 0.0), self._remaining_s + seconds
        voltage_v = output(self._x, self._dx, self._theta, self._file_constants, self._current_a, self._psi)
        return Reading(self._current_a, float(voltage_v), self._temperature_c)
