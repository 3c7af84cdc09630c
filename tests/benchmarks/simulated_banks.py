"""Recordings of simulated banks for ``tests.benchmarks.bank``: history rows, fits and true values, cached on disk.

The capacities and resistances of the cells have a spread and age, the temperature follows a season, and loads, depths and rests
change from cycle to cycle. The cell file of the estimator differs from the simulated cells, and its capacity is wrong.
"""

import copy
import hashlib
import itertools
import pickle
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

import bms_estimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.fit import PackFit, fit
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.simulation.simulated_bank import BankCells, BankHistory, SimulatedBank
from tests.pack_model.bank_cycles import cycle

T = TypeVar("T")

CACHE = Path(tempfile.gettempdir()) / "bank_cache"
"""Folder of recorded banks."""
DETECTOR = {"bank_comparison.py", "bank_monitor.py", "open_circuit.py"}
"""Files of ``pack_model`` that compare recordings. The recordings do not depend on them."""
STEP_S = 5.0
"""Interval between two samples [s]."""
BLOCK = 12
"""Number of samples of a block."""
NOISE_V, RESOLUTION_V = 2e-3, 5e-3
"""Noise and resolution of the bank's voltage [V]. The std of the noise is ``NOISE_V`` times the square root of the number of cells."""
FILE_CAPACITY_RATIO = 1.03
"""Capacity of the cell file relative to the true mean."""
MAX_GRADIENT_K = 5.0
"""Temperature difference between the coldest and the warmest cell [K]."""
MEAN_C, SEASON_K, DAY_STD_K, SEASON_CYCLES = 20.0, 10.0, 3.0, 24
"""Mean temperature [degC], amplitude of the season [K], std between days [K], and number of cycles of a year. A year is
short, so that few cycles contain all seasons."""
PARTIAL_CHARGE_CYCLES = 3
"""Number of cycles from one charge that ends early to the next."""
FIT_CYCLES = 3
"""Number of cycles between two fits. The service fits each hour; here this would take most of the time of a simulation."""
MAX_FADE, MAX_GROWTH, FADE_SPREAD = 1e-3, 2e-3, 0.2
"""Maximum relative loss of capacity and growth of resistance in a cycle, and their relative std between cells. The maximum loss is
about three times that of a cell that has 80 % of its capacity after 600 cycles."""
AXIS_STD_SOC = 0.02
"""Std of the deformation of the SOC axis of a true LFP cell at SOC 0.5."""


@dataclass(frozen=True)
class Chemistry:
    """True cell of a bank and the cell file of the estimator."""

    name: str
    cell: CellModel
    file: CellModel
    full_v: float
    """Voltage of a cell at which the charger limits the current [V]."""
    cutoff_v: float
    """Voltage of a cell at which the load is disconnected [V]."""


def nca() -> Chemistry:
    """Return an NCR18650 with the generic file ``nca``."""
    cell = load_cell("ncr18650")
    return Chemistry("NCA", cell, load_cell("nca", FILE_CAPACITY_RATIO * cell.cell.capacity_ah), 4.2, 2.8)


def lfp(rng: np.random.Generator) -> Chemistry:
    """Return a cell of 3 Ah, whose OCV curve is that of the generic file ``lfp`` with a random deformation of the SOC axis."""
    cell, file = load_cell("lfp", 3.0), load_cell("lfp", FILE_CAPACITY_RATIO * 3.0)
    assert isinstance(cell.ocv, TableOcv)
    soc = np.array(cell.ocv.soc)
    shift_soc = AXIS_STD_SOC * rng.standard_normal() * np.sin(np.pi * soc)
    ocv_v = np.interp(soc + shift_soc, soc, cell.ocv.ocv_v)
    true = cell.model_copy(update={"ocv": cell.ocv.model_copy(update={"ocv_v": tuple(ocv_v)})})
    return Chemistry("LFP", true, file, 3.6, 2.5)


CHEMISTRIES = {"NCA": lambda _: nca(), "LFP": lfp}
"""Chemistries by name."""


@dataclass(frozen=True)
class WeakCell:
    """Fault of one cell."""

    capacity_ratio: float = 1.0
    """Factor on the capacity of the cell."""
    soc_below: float = 0.0
    """Amount subtracted from the SOC of the cell."""


HEALTHY = WeakCell()
"""No fault."""
WEAK_CELLS = WeakCell(0.9), WeakCell(0.8), WeakCell(soc_below=0.1)
"""Simulated faults. Each continuation of a bank has one of them."""


@dataclass(frozen=True)
class Step:
    """Point of a discharge at which a row of the history was completed, with the true values."""

    cycle: int
    """Number of the cycle, from 0."""
    rows: int
    """Number of completed rows of the history."""
    drawn: float
    """Charge drawn in the discharge, as a fraction of the nominal capacity."""
    weakest_soc: float
    """True SOC of the weakest cell."""


@dataclass(frozen=True)
class Recording:
    """Recorded history of a bank."""

    curves: CellCurves
    """Curves of the estimator's cell file."""
    rows: NDArray[np.void]
    """Rows of the history, dtype HISTORY_ROW."""
    fits: list[PackFit]
    """Latest fit after each cycle without a fault."""
    steps: list[Step]
    """Points of all discharges, in order of time."""


class RecordedBank:
    """Simulated bank with the slow fit of its estimator, recorded from the first discharge on.

    Args:
        chemistry: Name in ``CHEMISTRIES``.
        series: Number of cells in series.
        seed: Seed of all random values.
        fade: Loss of capacity of one cell in each cycle, in addition to its aging.
    """

    def __init__(self, chemistry: str, series: int, seed: int, fade: float = 0.0) -> None:
        rng = self._rng = np.random.default_rng(seed)
        c = CHEMISTRIES[chemistry](rng)
        self._one_c = c.cell.cell.capacity_ah
        cells = BankCells.random(rng, series, self._one_c)
        cells.warmer_k[:] = np.linspace(0.0, rng.uniform(0.0, MAX_GRADIENT_K), series)
        spread = np.exp(FADE_SPREAD * rng.standard_normal((2, series)))
        self._fade, self._growth = rng.uniform(0.0, MAX_FADE) * spread[0], rng.uniform(0.0, MAX_GROWTH) * spread[1]
        self._fade[0] += fade
        self._season = rng.uniform(0.0, 2.0 * np.pi)
        self._bank = SimulatedBank(c.cell, cells, full_v=c.full_v * series, cutoff_v=c.cutoff_v * series)
        estimator = Estimator(c.file.pack(series, 1), voltage_resolution_v=RESOLUTION_V)
        self._slow_fit = SlowFit(estimator, interval_s=np.inf)  # fits are made once a cycle
        self._pack = Pack(estimator, self._slow_fit)
        self._number, self._fits, self._steps = 0, list[PackFit](), list[Step]()

    def run_cycles(self, cycles: int) -> None:
        """Simulate cycles, with a fit after the first ones and after every ``FIT_CYCLES``."""
        slow_fit = self._slow_fit
        for _ in range(cycles):
            self._run_cycle()
            if self._number < FIT_CYCLES or self._number % FIT_CYCLES == 0:
                slow_fit.adopt(fit(slow_fit.cell, slow_fit.history.rows, slow_fit.saved_fit))
            assert slow_fit.saved_fit is not None
            self._fits = [*self._fits, slow_fit.saved_fit]

    def recording(self, weak: WeakCell = HEALTHY) -> Recording:
        """Return the recording, followed by a cycle with a fault of the first cell unless ``weak`` is ``HEALTHY``.

        The fault is simulated on a copy of the bank.
        """
        bank = self
        if weak != HEALTHY:
            bank = copy.deepcopy(self)
            bank._bank.cells = bank._bank.cells.with_weak_cell(0, capacity_ratio=weak.capacity_ratio)
            bank._bank.discharge_cell(0, weak.soc_below)
            bank._run_cycle()
        return Recording(bank._slow_fit.cell, bank._slow_fit.history.rows, bank._fits, bank._steps)

    def _run_cycle(self) -> None:
        """Simulate one cycle and age the cells."""
        angle = self._season + 2.0 * np.pi * self._number / SEASON_CYCLES
        room_c = MEAN_C + SEASON_K * np.sin(angle) + DAY_STD_K * self._rng.standard_normal()
        is_partial = self._number % PARTIAL_CHARGE_CYCLES == 1
        charge_h = self._rng.uniform(1.0, 2.0) if is_partial else 4.0
        runs = cycle(self._bank, self._rng, STEP_S, one_c=self._one_c, room_c=room_c, charge_h=charge_h)
        for is_discharge, history in runs:
            self._measure(history, is_discharge=is_discharge)
        c = self._bank.cells
        self._bank.cells = replace(
            c, capacity_ah=c.capacity_ah * (1.0 - self._fade), ohm_factor=c.ohm_factor * (1.0 + self._growth)
        )
        self._number += 1

    def _measure(self, history: BankHistory, *, is_discharge: bool) -> None:
        """Process the samples of one run in blocks. Record a step after each block in which a row of a discharge was completed."""
        series = history.cell_soc.shape[1]
        samples = history.samples(self._rng, NOISE_V * np.sqrt(series), RESOLUTION_V)
        drawn = np.cumsum(history.current_a) * STEP_S / 3600.0 / self._one_c
        for begin in range(0, samples.size, BLOCK):
            self._pack.run(samples[begin : begin + BLOCK])
            rows, last = self._slow_fit.history.rows.size, min(begin + BLOCK, samples.size) - 1
            if is_discharge and (not self._steps or rows > self._steps[-1].rows):
                true_soc = max(float(history.cell_soc[last].min()), 0.0)
                step = Step(self._number, rows, float(drawn[last]), true_soc)
                self._steps = [*self._steps, step]


def recordings(
    chemistry: str, series: int, seed: int, weak: Sequence[WeakCell], cycles: Sequence[int], fade: float = 0.0
) -> list[Recording]:
    """Return recordings of a bank, from the cache if it has them.

    Args:
        chemistry: Name in ``CHEMISTRIES``.
        series: Number of cells in series.
        seed: Seed of all random values.
        weak: Faults.
        cycles: Numbers of cycles after which the bank is recorded for one more cycle with each fault.
        fade: Loss of capacity of one cell in each cycle, in addition to its aging.

    Returns:
        The recording without a fault, then those with faults.
    """

    def simulate() -> list[Recording]:
        bank, result = RecordedBank(chemistry, series, seed, fade), list[Recording]()
        for before, number in itertools.pairwise([0, *cycles]):
            bank.run_cycles(number - before)
            result += [bank.recording(each) for each in weak]
        return [bank.recording(), *result]

    return cached(f"{chemistry}-{series}-{seed}-{weak}-{cycles}-{fade}", simulate)


@cache
def source_digest() -> bytes:
    """Return a hash of the sources of simulation, filter and fit, so that a change of them gives new recordings."""
    package, digest = Path(bms_estimator.__file__).parent, hashlib.sha256(Path(__file__).read_bytes())
    for room in ("kernels", "estimator", "simulation", "model", "pack_model"):
        for source in sorted((package / room).rglob("*.py")):
            if source.name not in DETECTOR:
                digest.update(source.read_bytes())
    return digest.digest()


def cached(key: str, simulate: Callable[[], T]) -> T:
    """Return the result of an earlier simulation with the same key and the same sources."""
    path = CACHE / hashlib.sha256(source_digest() + key.encode()).hexdigest()
    if path.exists():
        result: T = pickle.loads(path.read_bytes())
        return result
    result = simulate()
    CACHE.mkdir(exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_bytes(pickle.dumps(result))
    partial.replace(path)
    return result
