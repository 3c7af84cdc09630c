"""Weakest cell of simulated banks in series: false alarms, charge drawn at detection, and error of its SOC.

Run ``make bank``, or ``python -m tests.benchmarks.bank --banks N``.

The true cells have the OCV and the resistances of ``ncr18650``, with a spread. The estimator has the generic file ``nca``.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.pack_model.learning import SlowFit
from bms_estimator.pack_model.weakest_cell import WeakestCell
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD
from bms_estimator.simulation.simulated_bank import BankCells
from tests.pack_model.bank_cycles import CELL, ONE_C, cycle, new_bank

SERIES = 3, 6, 12
"""Numbers of cells in series."""
STEP_S = 3.0
"""Interval between two samples [s]."""
BLOCK = 20
"""Number of samples of a block."""
NOISE_V, RESOLUTION_V = 2e-3, 5e-3
"""Std of the noise of a voltage sample per root of the number of cells, and resolution of the bank's voltage [V]."""
FIT_S = 86400.0
"""Interval between two slow fits [s]. The service fits each hour, which takes most of the time of this benchmark."""
FILE_CAPACITY_RATIO = 1.03
"""Capacity of the cell file relative to the true mean."""
MAX_GRADIENT_K = 5.0
"""Temperature difference between the coldest and the warmest cell [K]."""
HEALTHY_CYCLES = 5
"""Number of cycles before a cell becomes weak."""
REFERENCE_CYCLES = 2
"""Number of cycles of which no discharge is compared, because they are the first reference."""
MODEL_ERROR_V = 8e-3
"""Model error of a cell in the idealized bound [V]."""


@dataclass(frozen=True)
class Comparison:
    """Result after one row of a discharge."""

    cycle: int
    weakest: WeakestCell
    drawn: float
    """Charge drawn in the discharge, as a fraction of the mean capacity."""
    estimated: tuple[float, float]
    """SOC of the weakest cell and its std."""
    true_soc: float
    """True SOC of the weakest cell."""


def comparisons(
    series: int, seed: int, cycles: int, capacity_ratio: float = 1.0, soc_below: float = 0.0
) -> Iterator[Comparison]:
    """Yield the comparisons of a bank, one of whose cells becomes weak after ``HEALTHY_CYCLES``."""
    rng = np.random.default_rng(seed)
    cells = BankCells.drawn(rng, series, ONE_C)
    cells.warmer_k[:] = np.linspace(0.0, rng.uniform(0.0, MAX_GRADIENT_K), series)
    bank = new_bank(cells)
    file = load_cell("nca", FILE_CAPACITY_RATIO * ONE_C).pack(series, 1)
    slow_fit = SlowFit(Estimator(file, voltage_resolution_v=RESOLUTION_V), interval_s=FIT_S)
    assert slow_fit.bank is not None
    latest = None
    for number in range(cycles):
        if number == HEALTHY_CYCLES:
            bank.cells = cells.with_weak_cell(0, capacity_ratio=capacity_ratio)
            bank.discharge_cell(0, soc_below)
        for is_discharge, history in cycle(bank, rng, STEP_S):
            samples = history.samples(rng, NOISE_V * np.sqrt(series), RESOLUTION_V)
            drawn = np.cumsum(history.current_a) * STEP_S / 3600.0 / ONE_C
            for begin in range(0, samples.size, BLOCK):
                slow_fit.run(samples[begin : begin + BLOCK])
                weakest, last = slow_fit.bank.weakest, min(begin + BLOCK, samples.size) - 1
                if is_discharge and weakest is not None and weakest is not latest:
                    latest = weakest
                    estimated = weakest.weakest_soc(slow_fit.estimator.soc)
                    true_soc = max(float(history.cell_soc[last].min()), 0.0)
                    yield Comparison(number, weakest, float(drawn[last]), estimated, true_soc)


def bound(cell: CellModel, series: int, capacity_ratio: float) -> float:
    """Return the charge drawn at which the weak cell's deviation reaches three std of the sum of the model errors."""
    ocv_v = ocv_grid(cell)[0]
    soc = np.linspace(0.0, 1.0, ocv_v.size)
    drawn = np.linspace(0.0, capacity_ratio, 2000)
    healthy_v, weak_v = (np.interp(1.0 - x, soc, ocv_v) for x in (drawn, drawn / capacity_ratio))
    return float(drawn[np.argmax(healthy_v - weak_v > 3.0 * MODEL_ERROR_V * np.sqrt(series))])


def false_alarms(banks: int, cycles: int) -> None:
    """Print the largest deviations of healthy banks."""
    print_row("cells", "discharges", "above 1", "above 2", f"above {WEAK_CELL_STD:g}", "largest", "SOC within 2 std")
    for series in SERIES:
        largest: list[float] = []
        errors: list[float] = []
        for seed in range(banks):
            by_cycle: dict[int, float] = {}
            for each in comparisons(series, seed, cycles):
                by_cycle[each.cycle] = max(by_cycle.get(each.cycle, 0.0), each.weakest.deviation_std)
                errors.append((each.estimated[0] - each.true_soc) / each.estimated[1])
            largest += by_cycle.values()
        deviation = np.array(largest)
        limits = [f"{(deviation >= limit).sum()}" for limit in (1.0, 2.0, WEAK_CELL_STD)]
        print_row(
            series, banks * (cycles - REFERENCE_CYCLES), *limits, f"{deviation.max():.1f}", f"{within(errors):.0%}"
        )


def detections(banks: int) -> None:
    """Print the charge drawn at detection."""
    print_row(
        "cells",
        "capacity",
        "SOC below",
        "found",
        "charge drawn",
        "bound",
        "SOC of the weak cell",
        "RMS error of its SOC",
    )
    for series in SERIES:
        for ratio, below in ((0.9, 0.0), (0.8, 0.0), (1.0, 0.1)):
            drawn, errors, socs = [], [], []
            for seed in range(100, 100 + banks):
                found = [
                    each
                    for each in comparisons(series, seed, HEALTHY_CYCLES + 1, ratio, below)
                    if each.cycle == HEALTHY_CYCLES and each.weakest.deviation_std >= WEAK_CELL_STD
                ]
                if found:
                    drawn.append(found[0].drawn)
                    socs.append(found[0].true_soc)
                    errors += [each.estimated[0] - each.true_soc for each in found]
            ideal = f"{bound(CELL, series, ratio):.2f}" if ratio < 1.0 else "-"
            rms = f"{np.sqrt(np.mean(np.square(errors))):.3f}" if errors else "-"
            found_of = f"{len(drawn)} of {banks}"
            print_row(series, f"{ratio:g}", f"{below:g}", found_of, quantiles(drawn), ideal, quantiles(socs), rms)


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)  # noqa: T201


def within(errors: list[float]) -> float:
    """Return the fraction of normalized errors within 2 std."""
    return float(np.mean(np.abs(errors) <= 2.0)) if errors else np.nan


def quantiles(values: list[float] | Floats) -> str:
    """Return median and range as text."""
    return f"{np.median(values):.2f} ({np.min(values):.2f} to {np.max(values):.2f})" if len(values) else "-"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--banks", type=int, default=2, help="number of simulated banks of each kind")
    parser.add_argument("--cycles", type=int, default=16, help="number of cycles of a healthy bank")
    arguments = parser.parse_args()
    false_alarms(arguments.banks, arguments.cycles)
    detections(arguments.banks)


if __name__ == "__main__":
    main()
