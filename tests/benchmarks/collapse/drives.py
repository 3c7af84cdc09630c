"""Discharges for the study of the alarm before the cut-off: real captures, and simulated days of use."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bms_estimator.model.cell import CellModel
from bms_estimator.model.sample import SampleBlock
from bms_estimator.sources.captures.replay import load_capture
from tests.benchmarks.forecast.captures import Case
from tests.benchmarks.recipes import DATA, HIGHEST_V, LOWEST_V, cell_file
from tests.estimator.anywhere.use import drive
from tests.estimator.month.cases import NEW
from tests.estimator.month.packs import draw_pack, generator
from tests.estimator.month.simulation import simulate_use
from tests.estimator.month.sources import BOARD, measure
from tests.estimator.month.uses import HOUR_S, USES, PackState, Phase, Use, full_charge, rest

CUTOFF_V = {"a123": (2.5,), "leaf": (3.05, 3.2)}
"""Cut-off voltages of a cell [V] by the folder of its captures. The captures of the Leaf cell end at 3.0 V."""
OXIDE_CUTOFF_V = (2.6, 3.0)
"""Cut-off voltages of all other cells [V]."""
SLOW = ("c20", "0p1c")
"""Parts of the names of discharges at C/10 or less, which are left out: they would only dilute the rate of false alarms."""
DEEP_C, DEEP_ROOM_C = (0.2, 1.0), (-10.0, 35.0)
"""Range of the mean load [C] and of the temperature [C] of the simulated discharges to the cut-off."""


@dataclass(frozen=True)
class Recording:
    """Samples of a cell, and its cell file.

    Attributes:
        name: Name of the capture or of the simulation.
        cell: Cell file of the estimator.
        samples: Measured samples.
        cutoff_v: Cut-off voltages to study [V].
        is_simulated: True if the cell is simulated.
    """

    name: str
    cell: CellModel
    samples: SampleBlock
    cutoff_v: tuple[float, ...]
    is_simulated: bool


def captures(cases: Iterable[Case], folder: Path) -> Iterator[Recording]:
    """Yield the captures of all cases but ``SLOW``, with their cell files in ``folder``."""
    for case in cases:
        if any(part in case.name for part in SLOW):
            continue
        rows = load_capture(case.path).rows
        rows = rows[(rows["voltage_v"] > LOWEST_V) & (rows["voltage_v"] < HIGHEST_V)]
        cutoff_v = CUTOFF_V.get(case.path.parent.name, OXIDE_CUTOFF_V)
        yield Recording(case.name, cell_file(case.recipe, folder), rows, cutoff_v, is_simulated=False)


def deep(rng: np.random.Generator, pack: PackState) -> Iterator[Phase]:
    """Yield a full charge, a rest, and a drive with random load and temperature until the protection ends it."""
    while True:
        mean_c, room_c = rng.uniform(*DEEP_C), rng.uniform(*DEEP_ROOM_C)
        yield full_charge(pack, 0.5)
        yield rest(rng, 0.2, 0.6)
        yield Phase(drive(rng, pack.one_c, mean_c, int(2.0 * HOUR_S / mean_c)).clip(min=0.0), "empty", 0.0, room_c)
        yield rest(rng, 0.2, 0.6, room_c)


@dataclass(frozen=True)
class SimulatedUse:
    """Use of a simulated cell.

    Attributes:
        name: Name of the use.
        use: Phases of the use.
        above_empty_v: Cut-off voltage above the voltage at which the protection of the cell ends the discharge [V].
    """

    name: str
    use: Use
    above_empty_v: float


SIMULATED = (SimulatedUse("never_full", USES["never_full"], 0.2), SimulatedUse("deep", Use(deep), 0.02))
"""Drives that mostly stop at SOC 0.12, above the cut-off, and drives to the cut-off."""
SIMULATED_DAYS = 2
CELLS = ("LG M50", "NCR", "PF", "Leaf", "A123", "LFP")
"""Simulated cells (``tests.estimator.month.packs.CHEMISTRIES``)."""
SEED = 7
"""Seed of capacity, resistances and loads of the simulated cells."""


def simulations() -> Iterator[Recording]:
    """Yield the simulated days of each cell, with the cell file of another cell of its type."""
    for cell in CELLS:
        pack = draw_pack(cell, 3.0, SEED, DATA)
        file = pack.own_file(generator(cell, "own file", SEED))
        for each in SIMULATED:
            history = simulate_use(pack, each.use, NEW, SIMULATED_DAYS, generator(cell, each.name, SEED))
            samples = measure(BOARD, history, generator(cell, each.name, "collapse"))
            cutoff_v = float(pack.truth.ocv_v[0]) + each.above_empty_v
            yield Recording(f"{cell}, {each.name}", file, samples, (cutoff_v,), is_simulated=True)
