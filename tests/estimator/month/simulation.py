"""Simulation of a pack over weeks, phase by phase, with aging."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats
from tests.estimator.anywhere.truth import GRID, rest_state, simulate_from
from tests.estimator.anywhere.use import DAY_S
from tests.estimator.month.packs import Pack
from tests.estimator.month.uses import Phase, Use

FAST_SAMPLES = 100
"""Number of samples a second on the day that is simulated at a board's sample rate."""
TRUE_VALUES = np.dtype(
    [
        ("time_s", "f8"),
        ("current_a", "f8"),
        ("voltage_v", "f8"),
        ("temperature_c", "f8"),
        ("soc", "f8"),  # charge left over the present capacity
        ("capacity_ah", "f8"),
        ("is_seen", "?"),  # False: the electronics are off
    ]
)
"""True values at each sample."""


@dataclass(frozen=True)
class Aging:
    """Change of a pack with time."""

    name: str = ""
    capacity_per_day: float = 0.0
    """Loss of capacity each day, as a fraction of the initial capacity."""
    resistance_per_day: float = 0.0
    """Increase of the resistances each day, as a fraction of the initial ones."""
    resistance_per_day2: float = 0.0
    """Increase of the resistances per day squared, as a fraction of the initial ones."""
    ocv_v_per_day: float = 0.0
    """Change of the OCV at SOC 0.5 each day [V]. The change is 0 at SOC 0 and 1, because the voltage limits define these."""

    def resistance_ratio(self, days: float) -> float:
        """Return the ratio of the resistances to the initial ones."""
        return 1.0 + self.resistance_per_day * days + self.resistance_per_day2 * days**2


class SimulatedPack:
    """Pack whose phases are simulated one after the other. It begins at rest after a charge. It satisfies ``PackState``."""

    def __init__(self, pack: Pack, use: Use, aging: Aging, soc: float, fast_day: int = 0) -> None:
        self.pack, self.aging, self.fast_day, self.usual_step_s = pack, aging, fast_day, use.step_s
        self.charger_v = pack.charger_v(use.charger_c)
        self.one_c = pack.declared_ah
        self.time_s = 0.0
        self.state = rest_state(soc, 1.0)

    @property
    def soc(self) -> float:
        """SOC after the last phase."""
        return float(self.state[0])

    @property
    def samples_per_step(self) -> int:
        """Number of samples in which each requested current is simulated: ``FAST_SAMPLES`` on ``fast_day``."""
        return FAST_SAMPLES if int(self.time_s // DAY_S) + 1 == self.fast_day else 1

    def run(self, phase: Phase) -> np.ndarray:
        """Simulate a phase until its end, and return its true values, dtype ``TRUE_VALUES``."""
        before, step_s = self.state.copy(), self.usual_step_s / self.samples_per_step
        request_a = np.repeat(phase.current_a, self.samples_per_step)
        history = self.simulate(phase, request_a, step_s)
        count = samples_until_end(phase, history)
        if count < history.size:
            self.state = before  # the next phase begins with the state at the end of this one
            history = self.simulate(phase, request_a[:count], step_s)
        self.time_s += count * step_s
        return history

    def simulate(self, phase: Phase, request_a: Floats, step_s: float) -> np.ndarray:
        """Return the true values for requested currents. Capacity and resistances are constant within a phase."""
        truth, days = self.pack.truth, self.time_s / DAY_S
        history = np.zeros(request_a.size, dtype=TRUE_VALUES)
        current_a, room_c = request_a.copy(), np.full(request_a.size, phase.room_c)
        capacity_ah = truth.capacity_ah * (1.0 - self.aging.capacity_per_day * days)
        ohm = truth.ohm * self.aging.resistance_ratio(days)
        ocv_v = truth.ocv_v + self.aging.ocv_v_per_day * days * np.sin(np.pi * GRID)
        curves = ocv_v, truth.per_kelvin_v, truth.hysteresis_v, ohm
        self_heating_k_per_w, low_v = 0.0, truth.ocv_v[0]
        history["voltage_v"], history["soc"] = simulate_from(
            self.state, step_s, current_a, room_c, capacity_ah, *curves, self_heating_k_per_w, low_v, self.charger_v
        )
        history["time_s"] = self.time_s + step_s * np.arange(request_a.size)
        history["current_a"], history["temperature_c"] = current_a, room_c
        history["capacity_ah"], history["is_seen"] = capacity_ah, phase.is_seen
        return history


def samples_until_end(phase: Phase, history: np.ndarray) -> int:
    """Return the number of samples until the end of a phase."""
    ends = {
        "time": lambda: np.zeros(history.size, dtype=bool),
        "empty": lambda: history["soc"] < phase.soc,
        "charged_to": lambda: history["soc"] > phase.soc,
        "stopped": lambda: history["current_a"] == 0.0,
    }[phase.end]()
    return int(np.argmax(ends)) if ends.any() else history.size


def simulate_phases(use: Use, pack: SimulatedPack, rng: np.random.Generator, days: int) -> Iterator[np.ndarray]:
    """Yield the true values of each phase of these days."""
    phases = use.phases(rng, pack)
    while pack.time_s < days * DAY_S:
        yield pack.run(next(phases))


def simulate_use(
    pack: Pack, use: Use, aging: Aging, days: int, rng: np.random.Generator, fast_day: int = 0
) -> np.ndarray:
    """Return the true values of ``days`` days, dtype ``TRUE_VALUES``.

    ``fast_day`` is the number of the day with ``FAST_SAMPLES`` times as many samples; 0: none.
    """
    simulated = SimulatedPack(pack, use, aging, rng.uniform(*use.initial_soc), fast_day)
    history = np.concatenate(list(simulate_phases(use, simulated, rng, days)))
    return history[history["time_s"] < days * DAY_S]
