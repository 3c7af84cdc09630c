"""Simulated discharges: trips whose load changes, at temperatures of which there are few real captures.

The true cell and the errors of its file are those of ``tests.estimator.anywhere``.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from tests.benchmarks.forecast.captures import OXIDE_CUTOFF_V, PHOSPHATE_CUTOFF_V, SIMULATED, Case
from tests.benchmarks.forecast.truth import Discharge, discharge_of
from tests.benchmarks.recipes import Recipe
from tests.estimator.anywhere import cases as simulated
from tests.estimator.anywhere.truth import Truth
from tests.estimator.anywhere.use import drive
from tests.estimator.month.uses import REGENERATION_MIN_C

TRIP_S, REST_S = (600, 2400), (120, 600)
"""Ranges of the duration of a trip and of the rest after it [s]."""
TRIP_C, COLD_TRIP_C = (0.2, 0.9), (0.15, 0.5)
"""Ranges of the mean current of a trip, and of a trip below ``REGENERATION_MIN_C`` [C]."""
LOAD_S = 5 * 3600
"""Duration of the load, which is longer than the discharge [s]."""
OWN_TEMPERATURES_C, ONE_TEMPERATURE_C = (25.0, 10.0, 0.0, -10.0), (25.0,)
"""Temperatures at which the data of a cell file were measured [C]."""


@dataclass(frozen=True)
class Simulation:
    """Parameters of one simulated discharge."""

    truth: Truth
    temperature_c: float
    file_temperatures_c: tuple[float, ...]
    """Temperatures at which the data of the cell file were measured [C]."""
    seed: int

    @property
    def name(self) -> str:
        """Name of the case."""
        cell = "LFP" if self.truth is simulated.PHOSPHATE else "oxide"
        return f"simulated {cell} at {self.temperature_c:g} C, {self.seed}"

    @property
    def case(self) -> Case:
        """Case as which the outcomes are counted."""
        chemistry = "lfp" if self.truth is simulated.PHOSPHATE else "nmc"
        return Case(self.name, Recipe(self.truth.capacity_ah, generic=chemistry), SIMULATED)


SIMULATIONS = (
    *(
        Simulation(simulated.OXIDE, temperature_c, OWN_TEMPERATURES_C, seed)
        for temperature_c, seed in product((25.0, 10.0, 0.0, -10.0, -20.0), (1, 2))
    ),
    *(
        Simulation(simulated.OXIDE, temperature_c, ONE_TEMPERATURE_C, seed)
        for temperature_c, seed in product((40.0, 0.0), (3, 4))
    ),
    *(Simulation(simulated.PHOSPHATE, temperature_c, (25.0, 5.0, -15.0), 5) for temperature_c in (25.0, 5.0, -15.0)),
)


def simulate_discharge(simulation: Simulation) -> tuple[Discharge, CellModel]:
    """Return the discharge until the cut-off, and the cell file of the estimator."""
    truth = simulation.truth
    capture = simulated.capture(
        simulated.Case(
            simulation.name,
            truth=truth,
            temperature_c=simulation.temperature_c,
            load_before_h=0.0,
            soc=1.0,
            file_temperatures_c=simulation.file_temperatures_c,
            seed=simulation.seed,
        ),
        trips(truth.capacity_ah, simulation.temperature_c, np.random.default_rng(simulation.seed)),
    )
    cutoff_v = PHOSPHATE_CUTOFF_V if truth is simulated.PHOSPHATE else OXIDE_CUTOFF_V
    discharge = discharge_of(capture.samples, cutoff_v, truth.capacity_ah)
    assert discharge is not None, f"{simulation.name}: the load does not discharge the cell"
    return discharge, capture.cell


def trips(one_c: float, temperature_c: float, rng: np.random.Generator) -> Floats:
    """Return the current of trips with rests between them at 1 Hz [A]. ``one_c`` is the current of 1 C [A]."""
    is_cold = temperature_c < REGENERATION_MIN_C
    parts = [np.zeros(REST_S[0])]
    while sum(part.size for part in parts) < LOAD_S:
        trip_a = drive(rng, one_c, rng.uniform(*(COLD_TRIP_C if is_cold else TRIP_C)), int(rng.integers(*TRIP_S)))
        parts += [np.maximum(trip_a, 0.0) if is_cold else trip_a, np.zeros(int(rng.integers(*REST_S)))]
    return np.concatenate(parts)[:LOAD_S]
