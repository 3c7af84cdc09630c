"""Simulated pack under an endless load, with the cell model of Chen and Mora, (2.1) to (2.4) of the thesis.

A simulated BMS of the pack responds to requests on a pseudo-terminal, with optional faults; and a simulated fuel cell stack.
"""

import math
import random
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum, StrEnum

import numpy as np

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.kernels.cell_model.fuel_cell import advance, load_file_constants, output, steady_state
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.cell import CellModel
from bms_estimator.model.pack_model import FuelCellModel
from bms_estimator.simulation.bms_responses import BMS_RESPONSES, MAX_CELLS, Measured
from bms_estimator.simulation.simulated_meter import Signal, SimulatedMeter
from bms_estimator.simulation.virtual_adc import Reading

EMPTY_SOC = 0.05
"""SOC at which the load stops and the pack is charged."""
FULL_SOC = 0.95
"""SOC up to which the pack is charged. Above this SOC the load does not charge it."""
ROOM_C = 25.0
"""Temperature of the pack [degC]."""
PULSE_S = 10.0
"""Duration of a pulse, and of the pause after it [s]."""
MIN_STEP_S, MAX_STEP_S = 1.0, 5.0
"""Range of the duration of a random step [s]."""
MAX_CHARGE_FRACTION = 0.25
"""Maximum charging current of random steps, as a fraction of the load current."""

Load = Iterator[tuple[float, float]]
"""Endless sequence of duration [s] and current [A], positive on discharge."""


def constant(current_a: float, _seed: int = 0) -> Load:
    """Yield a constant current."""
    while True:
        yield math.inf, current_a


def pulses(current_a: float, _seed: int = 0) -> Load:
    """Yield alternately ``PULSE_S`` of the current and of no current."""
    while True:
        yield PULSE_S, current_a
        yield PULSE_S, 0.0


def random_steps(current_a: float, seed: int = 0) -> Load:
    """Yield steps of random duration and current; some of them charge."""
    rng = random.Random(seed)
    while True:
        yield rng.uniform(MIN_STEP_S, MAX_STEP_S), current_a * rng.uniform(-MAX_CHARGE_FRACTION, 1.0)


class LoadName(StrEnum):
    """Kinds of load."""

    CONSTANT = "constant"
    PULSE = "pulse"
    RANDOM = "random"
    RELAY = "relay"
    """Load that the relay of a board connects, see ``PackWithRelay``."""


LOADS: dict[LoadName, Callable[[float, int], Load]] = {
    LoadName.CONSTANT: constant,
    LoadName.PULSE: pulses,
    LoadName.RANDOM: random_steps,
}
"""Function that creates a load from its current [A] and a seed."""


class SimulatedPack:
    """Simulated pack. Call the object with times that never decrease.

    An empty pack is charged; a full one is not charged further.

    Args:
        cell: Cell model of the whole pack.
        load: Load profile.
        soc: SOC at time 0, 0..1, at which the pack is at rest.
    """

    def __init__(self, cell: CellModel, load: Load, *, soc: float = 0.9) -> None:
        self._a, self._capacity_as = cell.a, cell.cell.capacity_ah * 3600.0
        self._ocv = ocv_grid(cell)
        self._charge_a = -cell.cell.capacity_ah  # 1C; charging is negative
        self._load = load
        self._remaining_s, self._load_a = next(load)
        self._charging = False
        self._state = (soc, 0.0, 0.0)
        self._current_a = self._load_a
        self.time_s = 0.0
        """Time of the last reading [s]."""

    @property
    def soc(self) -> float:
        """True SOC, 0..1."""
        return self._state[0]

    def __call__(self, time_s: float) -> Reading:
        """Return voltage and current at the pack's terminals at ``time_s`` [s]."""
        dt_s, self.time_s = time_s - self.time_s, time_s
        self._state = cell_step(self._state, self._current_a, dt_s, self._capacity_as, self._a)
        self._current_a = self._next_current(dt_s)
        soc, v_ts, v_tl = self._state
        voltage_v = ocv(soc, *self._ocv) - v_ts - v_tl - self._current_a * r_s(soc, self._a)  # (2.4) of the thesis
        return Reading(self._current_a, float(voltage_v), ROOM_C)

    def _next_current(self, dt_s: float) -> float:
        """Return the current ``dt_s`` later. The load pauses while the pack is charged."""
        # hysteresis: a charge that begins at EMPTY_SOC ends at FULL_SOC
        self._charging = self.soc <= (FULL_SOC if self._charging else EMPTY_SOC)
        if self._charging:
            return self._charge_a
        self._remaining_s -= dt_s
        while self._remaining_s <= 0.0:
            seconds, self._load_a = next(self._load)
            self._remaining_s += seconds
        return max(self._load_a, 0.0) if self.soc >= FULL_SOC else self._load_a


class PackWithRelay(SimulatedPack):
    """Simulated pack whose load is connected by a relay. It is never charged.

    Args:
        cell: Cell model of the whole pack.
        load_a: Current of the load [A].
        soc: SOC at time 0, 0..1, at which the pack is at rest.
    """

    def __init__(self, cell: CellModel, load_a: float, *, soc: float) -> None:
        super().__init__(cell, constant(0.0), soc=soc)
        self._connected_a = load_a
        self.is_connected: Callable[[], bool] = lambda: False
        """Function that returns True while the relay connects the load."""

    def _next_current(self, _dt_s: float) -> float:
        """Return the current of the load while it is connected and the pack is not empty."""
        return self._connected_a if self.is_connected() and self.soc > 0.0 else 0.0


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
