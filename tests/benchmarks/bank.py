"""Weakest cell of simulated banks in series: false alarms, charge drawn at detection, and error of its SOC.

Run ``make bank``, or ``python -m tests.benchmarks.bank --banks N --seed S``. The first run simulates the banks
(``tests.benchmarks.simulated_banks``); later runs take them from a cache.
"""

import argparse
import itertools
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.accumulators.history import ROW_SOC
from bms_estimator.model.arrays import Floats
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.pack_model.bank_monitor import BankMonitor, is_discharge
from bms_estimator.pack_model.history import History
from bms_estimator.settings.alarm_limits import WEAK_CELL_STD
from tests.benchmarks.simulated_banks import CHEMISTRIES, WEAK_CELLS, Recording, Step, recordings
from tests.pack_model.bank_cycles import CELL

SERIES = 3, 6, 12
"""Numbers of cells in series."""
WORKERS = 2
"""Number of processes."""
REFERENCE_CYCLES = 2
"""Number of cycles at the beginning that are not compared, because they are the first reference."""
WEAK_AFTER = 6, 12
"""Numbers of healthy cycles before the cycle with a weak cell. Each fault is simulated after each of them."""
FADE, FADE_CYCLES = 0.012, 18
"""Loss of capacity of a slowly weakening cell in each cycle, and number of cycles."""
LIMITS_STD = 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0
"""Limits of the deviation for which the false alarms are counted [std]."""
MODEL_ERROR_V = 8e-3
"""Model error of a cell in the idealized bound [V]."""


@dataclass(frozen=True)
class RowResult:
    """Estimate of the weakest cell after one row of a discharge, with the true values."""

    step: Step
    weakest: ComparedCell

    @property
    def error(self) -> float:
        """Error of the SOC of the weakest cell."""
        return self._estimate[0] - self.step.weakest_soc

    @property
    def error_std(self) -> float:
        """Error of the SOC of the weakest cell, relative to its std."""
        return self.error / self._estimate[1]

    @property
    def _estimate(self) -> tuple[float, float]:
        """Estimated SOC of the weakest cell, and its std. The SOC of a row belongs to its middle, and the true value to its end."""
        return self.weakest.weakest_soc(self.weakest.filter_soc - 0.5 * ROW_SOC)


def compare(recording: Recording, history: History, first_cycle: int = REFERENCE_CYCLES) -> Iterator[RowResult]:
    """Yield the results of a recorded bank, from the cycle ``first_cycle`` on.

    Each discharge is compared by a new monitor, because a monitor does not replace the result of a deeper discharge.

    Args:
        recording: Recording of the bank.
        history: History of the bank, empty or with its first discharges; updated.
        first_cycle: Number of the first compared cycle.
    """
    compared = (step for step in recording.steps if step.cycle >= first_cycle)
    for _, steps in itertools.groupby(compared, lambda step: step.cycle):
        monitor, latest = BankMonitor(recording.curves), None
        history.weak_cell_times.clear()
        rows = None
        for step in steps:
            history.rows = recording.rows[: step.rows]
            new = 1 if rows is None else step.rows - rows  # the first step has no row of the previous discharge
            monitor.add(history, new, recording.fits[step.cycle - 1])
            rows = step.rows
            if monitor.weakest is not None and monitor.weakest is not latest:
                latest = monitor.weakest
                yield RowResult(step, latest)


@dataclass(frozen=True)
class HealthyResult:
    """Results of a healthy bank."""

    deviations: list[float]
    """Largest deviation of each discharge [std]."""
    errors_std: list[float]
    """Errors of the SOC of the weakest cell, relative to their std."""
    hours: float
    """Duration of the compared discharges [h]."""


@dataclass(frozen=True)
class WeakResult:
    """Results of a bank with a weak cell."""

    detections: list[RowResult]
    """Results at or above the limit of the alarm; empty if the weak cell was not found."""


def evaluate(chemistry: str, series: int, seed: int) -> tuple[HealthyResult, list[WeakResult]]:
    """Return the results of one bank without a fault, and with each of ``WEAK_CELLS`` after each of ``WEAK_AFTER``."""
    healthy, *faults = recordings(chemistry, series, seed, WEAK_CELLS, WEAK_AFTER)
    largest: dict[int, float] = {}
    errors: list[float] = []
    history = History()
    for each in compare(healthy, history):
        number = each.step.cycle
        largest[number] = max(largest.get(number, 0.0), each.weakest.deviation_std)
        errors.append(each.error_std)
    last = [step.rows for step in healthy.steps if step.cycle < REFERENCE_CYCLES][-1]
    compared = healthy.rows[last:]
    hours = float(compared["duration_s"][is_discharge(compared)].sum()) / 3600.0
    return HealthyResult(list(largest.values()), errors, hours), [
        WeakResult(detections(recording, history, recording.steps[-1].cycle)) for recording in faults
    ]


def detections(recording: Recording, history: History, first_cycle: int) -> list[RowResult]:
    """Return the results at or above the limit of the alarm, from the cycle ``first_cycle`` on."""
    return [each for each in compare(recording, history, first_cycle) if each.weakest.deviation_std >= WEAK_CELL_STD]


def evaluate_fade(series: int, seed: int) -> float:
    """Return the capacity of a slowly weakening NCA cell at its detection, relative to its initial capacity.

    The aging of all cells is not included. NaN: the cell was not found.
    """
    (recording,) = recordings("NCA", series, seed, (), (FADE_CYCLES,), FADE)
    found = detections(recording, History(), REFERENCE_CYCLES)
    return (1.0 - FADE) ** found[0].step.cycle if found else np.nan


def bound(series: int, capacity_ratio: float) -> float:
    """Return the charge drawn at which the effect of a weak cell on the bank's voltage exceeds 3 std of the sum of the model errors.

    Args:
        series: Number of cells in series.
        capacity_ratio: Capacity of the weak cell relative to the others.
    """
    ocv_v = ocv_grid(CELL)[0]
    soc = np.linspace(0.0, 1.0, ocv_v.size)
    drawn = np.linspace(0.0, capacity_ratio, 2000)
    healthy_v, weak_v = (np.interp(1.0 - x, soc, ocv_v) for x in (drawn, drawn / capacity_ratio))
    return float(drawn[np.argmax(healthy_v - weak_v > 3.0 * MODEL_ERROR_V * np.sqrt(series))])


def print_healthy(results: dict[tuple[str, int], list[HealthyResult]]) -> None:
    """Print the deviations of healthy banks and the false alarms at several limits."""
    print_row("cells", "discharges", "RMS deviation", "largest", "false alarms", "SOC within 2 std")
    for (chemistry, series), banks in results.items():
        deviation = np.concatenate([bank.deviations for bank in banks])
        errors = np.concatenate([bank.errors_std for bank in banks])
        false_alarms, within = (deviation >= WEAK_CELL_STD).sum(), np.mean(np.abs(errors) <= 2.0)
        rms = np.sqrt(np.mean(deviation**2))
        print_row(
            f"{series} {chemistry}",
            deviation.size,
            f"{rms:.2f}",
            f"{deviation.max():.1f}",
            false_alarms,
            f"{within:.0%}",
        )
    banks = [bank for group in results.values() for bank in group]
    deviation, hours = np.concatenate([bank.deviations for bank in banks]), sum(bank.hours for bank in banks)
    print_row("limit [std]", f"false alarms in {deviation.size} discharges of {hours:.0f} h", "in 100 h")
    for limit in LIMITS_STD:
        count = (deviation >= limit).sum()
        print_row(f"{limit:g}", count, f"{100.0 * count / hours:.2f}")


def print_weak(results: dict[tuple[str, int], list[list[WeakResult]]]) -> None:
    """Print the charge drawn at detection."""
    print_row("cells", "weak cell", "found", "charge drawn", "bound", "SOC of the weak cell", "RMS error of its SOC")
    for (chemistry, series), banks in results.items():
        for i, weak in enumerate(WEAK_CELLS):
            by_bank = [result.detections for bank in banks for result in bank[i :: len(WEAK_CELLS)]]
            first = [rows[0].step for rows in by_bank if rows]
            errors = [row.error for rows in by_bank for row in rows]
            fault = (
                f"capacity {weak.capacity_ratio:.0%}" if weak.capacity_ratio < 1.0 else f"SOC {weak.soc_below:g} lower"
            )
            has_bound = chemistry == "NCA" and weak.capacity_ratio < 1.0
            print_row(
                f"{series} {chemistry}",
                fault,
                f"{len(first)} of {len(by_bank)}",
                quantiles([step.drawn for step in first]),
                f"{bound(series, weak.capacity_ratio):.2f}" if has_bound else "",
                quantiles([step.weakest_soc for step in first]),
                f"{np.sqrt(np.mean(np.square(errors))):.3f}" if errors else "",
            )


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)  # noqa: T201


def quantiles(values: list[float] | Floats) -> str:
    """Return median and range as text."""
    return f"{np.median(values):.2f} ({np.min(values):.2f} to {np.max(values):.2f})" if len(values) else ""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--banks", type=int, default=5, help="number of banks of each size and chemistry")
    parser.add_argument("--seed", type=int, default=2000, help="seed of the first bank")
    parser.add_argument("--fade", type=int, default=3, help="number of banks with a slowly weakening cell")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.banks)
    groups = [(chemistry, series) for chemistry in CHEMISTRIES for series in SERIES]
    with ProcessPoolExecutor(WORKERS) as pool:
        pending = {group: [pool.submit(evaluate, *group, seed) for seed in seeds] for group in groups}
        results = {group: [future.result() for future in futures] for group, futures in pending.items()}
        print_healthy({group: [healthy for healthy, _ in banks] for group, banks in results.items()})
        print_weak({group: [weak for _, weak in banks] for group, banks in results.items()})
        for series in SERIES[:2]:
            banks = [pool.submit(evaluate_fade, series, seed) for seed in seeds[: arguments.fade]]
            print_row(f"{series} NCA", f"{FADE:.1%} less in each cycle", *(f"{bank.result():.2f}" for bank in banks))


if __name__ == "__main__":
    main()
