"""Full cycles and charges from empty on the first day of a cell of which only chemistry and capacity are known.

The estimator has the generic cell file and no initial SOC. The true cell has the OCV of a measured cell (LG M50, NCR18650,
Leaf, the LFP test cell) or a random OCV with errors up to 1.5 std (LCO, LTO). Its resistances are 0.7 to 3 times as large as
in the generic cell.
"""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.records import LN_Q
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.cell_sections import TableOcv
from bms_estimator.pack.pack import Pack
from bms_estimator.pack_model.slow_fit import SlowFit
from tests.estimator.anywhere.cases import OXIDE, PHOSPHATE, rising
from tests.estimator.anywhere.score import Score, score
from tests.estimator.anywhere.truth import GRID, curve_of, measured_curve, simulate, smooth
from tests.estimator.anywhere.use import drive

CAPACITY_AH = 3.0
"""Capacity of all cells [Ah]."""
AFTER_S = 300.0
"""Time after switch-on that is not scored [s]."""
EMPTY_SOC = 0.02
"""SOC at which a capture ends after the charge."""
REST_S = 900
"""Rest between two phases [s]."""
TAIL_S = 4 * 3600
"""Maximum duration of the drive after the charge [s]."""
MAX_CHARGE_S = 8 * 3600
"""Maximum duration of the charge [s]; the charger ends it earlier."""


@dataclass(frozen=True)
class Cycle:
    """Parameters of one capture."""

    chemistry: Literal["nmc", "nca", "lfp", "lmo", "lco", "lto"]
    begin: Literal["discharge", "charge"]
    """First phase: a discharge at 1 C to empty, or the charge of an empty cell."""
    resistance: float
    """Resistance of the true cell divided by the resistance of the generic cell."""
    soc: float
    """SOC at the first sample, from rest."""
    charge_c: float = 1.0
    """Charge current [C]."""
    seed: int = 1

    @property
    def name(self) -> str:
        """Name in the summary."""
        return f"{self.chemistry} {self.begin} from {self.soc:.2f}, R x{self.resistance:g}"


def cycles(chemistry: str) -> tuple[Cycle, ...]:
    """Return the cycles of one generic cell."""
    # different seeds for all cycles
    from_discharge = [Cycle(chemistry, "discharge", r, soc, seed=n) for n, (r, soc) in enumerate(DISCHARGES)]
    from_charge = [Cycle(chemistry, "charge", r, soc, c, seed=20 + n) for n, (r, soc, c) in enumerate(CHARGES)]
    return (*from_discharge, *from_charge)


DISCHARGES = ((0.7, 0.41), (1.0, 0.7), (1.5, 0.41), (2.0, 0.55), (3.0, 0.41), (3.0, 0.8))
"""Full cycles: ratio of the resistance to the generic cell's, and initial SOC."""
CHARGES = ((0.7, 0.03, 1.0), (1.0, 0.05, 0.3), (2.0, 0.02, 0.5), (3.0, 0.05, 1.0))
"""Charges from empty: ratio of the resistance to the generic cell's, initial SOC, and current [C]."""
LFP_CYCLE_WITH_TRIPLED_RESISTANCE = Cycle("lfp", "discharge", resistance=1.815, soc=0.41)
"""Cycle of a cell whose resistances, multiplied by the capacity, are three times as large as in ``PHOSPHATE``."""
MAX_CURVE_STDS = 1.5
"""Maximum error of a random true curve, in std of the generic curve."""
CHEMISTRIES = ("nmc", "nca", "lfp", "lmo", "lco", "lto")


def true_curve(cycle: Cycle) -> Floats:
    """Return the OCV of the true cell at ``GRID`` [V]."""
    if cycle.chemistry == "nmc":
        return measured_curve()
    if cycle.chemistry == "lfp":
        return PHOSPHATE.ocv_v
    measured_cell = {"nca": "ncr18650", "lmo": "leaf"}.get(cycle.chemistry)
    if measured_cell is not None:
        ocv = load_cell(measured_cell).ocv
        assert isinstance(ocv, TableOcv)
        return PchipInterpolator(ocv.soc, ocv.ocv_v)(GRID)
    ocv = load_cell(cycle.chemistry, 1.0).ocv
    assert isinstance(ocv, TableOcv)
    assert ocv.error_v is not None
    shape = smooth(np.random.default_rng(cycle.seed), 0.6)
    error_v = MAX_CURVE_STDS * np.interp(GRID, ocv.soc, ocv.error_v) * shape / np.abs(shape).max()
    return rising(curve_of(cycle.chemistry) + error_v) + 1e-5 * GRID


def load(cycle: Cycle, rng: np.random.Generator, charge_s: int) -> Floats:
    """Return the requested current at 1 Hz [A]: a discharge to empty or a rest, a charge, and a drive.

    Rests lie between these phases. ``charge_s`` is the duration of the charge.
    """
    one_c = CAPACITY_AH
    begin = np.r_[np.full(3600, one_c), np.zeros(REST_S)] if cycle.begin == "discharge" else np.zeros(REST_S)
    return np.r_[begin, np.full(charge_s, -cycle.charge_c * one_c), np.zeros(REST_S), drive(rng, one_c, 0.5, TAIL_S)]


def capture(cycle: Cycle) -> tuple[SampleBlock, Floats]:
    """Return samples at 1 Hz until the cell is empty after the charge, and the true SOC at each sample."""
    truth = PHOSPHATE if cycle.chemistry in ("lfp", "lto") else OXIDE
    ocv_v, generic = true_curve(cycle), load_cell(cycle.chemistry, CAPACITY_AH)
    scale = cycle.resistance * total_ohm(generic) / truth.ohm[GRID.size // 2].sum()
    curves = ocv_v, truth.per_kelvin_v, truth.hysteresis_v, scale * truth.ohm
    limits = {"low_v": ocv_v[0], "high_v": ocv_v[-1]}

    def run(charge_s: int) -> tuple[Floats, Floats, Floats]:
        """Return the current that flowed, the voltage and the SOC."""
        current_a = load(cycle, np.random.default_rng(3000 + cycle.seed), charge_s)
        room_c = np.full(current_a.size, 25.0)
        hysteresis = -1.0  # the cell was discharged
        return current_a, *simulate(1.0, current_a, room_c, cycle.soc, hysteresis, CAPACITY_AH, *curves, **limits)

    # The first run shows when the charger ends the charge. In the second run, the rest after the charge begins then.
    current_a, _, _ = run(MAX_CHARGE_S)
    charge_s = int(np.count_nonzero(current_a[: -REST_S - TAIL_S] < 0.0))
    current_a, voltage_v, soc = run(charge_s)
    empty = np.flatnonzero((soc < EMPTY_SOC) & (np.arange(soc.size) > soc.argmax()))
    end = int(empty[0]) if empty.size else soc.size
    rng = np.random.default_rng(4000 + cycle.seed)
    samples = np.zeros(end, dtype=SAMPLE)
    samples["time_s"] = np.arange(end)
    samples["current_a"] = np.round(current_a[:end] + rng.normal(0.0, 2e-3, end), 3)
    samples["voltage_v"] = np.round(voltage_v[:end] + rng.normal(0.0, 5e-4, end), 3)
    samples["temperature_c"] = 25.0
    return samples, soc[:end]


def total_ohm(cell: CellModel) -> float:
    """Return the sum of a cell's resistances at SOC 0.5 and 25 C [ohm]."""
    ladder = cell.ladder
    assert ladder is not None
    return float(sum(np.interp(0.5, ladder.soc, row) for row in (*ladder.weak_ohm, *ladder.strong_ohm)))


@dataclass(frozen=True)
class CycleRow:
    """Result of the estimator on one capture."""

    cycle: Cycle
    score: Score
    capacity_error_percent: float
    """Relative error of the learned capacity [%]."""
    reinitializations: int
    """Number of re-initializations of the filter."""

    @property
    def line(self) -> list[str]:
        """Return the columns ``SUMMARY_COLUMNS`` of the checked-in summary."""
        values = (self.score.rmse, self.score.cover, self.score.std, self.score.score, self.capacity_error_percent)
        return [self.cycle.name, *(f"{value:.1f}" for value in values)]


SUMMARY_COLUMNS = ["cycle", "rmse", "cover", "std", "score", "capacity"]
SUMMARY_PATH = Path(__file__).with_name("cycles.csv")


def row(cycle: Cycle) -> CycleRow:
    """Run the estimator and its slow fit with the generic cell file and without an initial SOC."""
    samples, soc = capture(cycle)
    estimator = Estimator(load_cell(cycle.chemistry, CAPACITY_AH))
    trace = Pack(estimator, SlowFit(estimator)).run(samples).trace
    result = score(samples["time_s"], trace["soc"], trace["soc_std"], soc, AFTER_S)
    assert result is not None
    f = estimator.record[0]["filter"]
    return CycleRow(cycle, result, 100.0 * float(np.expm1(f["mean"][f["best"], LN_Q])), int(f["reopened"]))


def rows(chemistry: str) -> list[CycleRow]:
    """Return the results of all captures of one generic cell."""
    return [row(cycle) for cycle in cycles(chemistry)]


def write(table: Iterable[CycleRow]) -> None:
    """Write the checked-in summary."""
    with SUMMARY_PATH.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([SUMMARY_COLUMNS, *(r.line for r in table)])
