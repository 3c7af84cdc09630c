"""Figures of the estimators of single cells: detection of shorts, false alarms, balancers. ``make cells``; docs/pack/cells.md.

Three detectors of the field see the same cell voltages and are calibrated on the same healthy packs: the Shannon entropy of the cell
voltages, the difference of a cell from the mean cell, and a CUSUM of this difference.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.alarm_limits import MIN_READING_ERROR_V, MIN_SHORT_C, balancing_voltage_v
from bms_estimator.settings.observer import BOARD
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank

CELLS, CAPACITY_AH, STEP_S = 12, 50.0, 30.0
"""Number of cells, their capacity [Ah], and the interval of the samples [s]."""
BLOCKS = 6
"""Number of simulated blocks in an hour."""
NOISE_V, OFFSET_V, RESOLUTION_V = 5e-4, 1e-3, 1e-3
"""Std of the noise of a reading, std of its constant offset, and its resolution [V]."""
WARMER_K = 5.0
"""Difference of the temperatures of the last and the first cell [K]."""
AGING = 2e-4
"""Mean relative loss of capacity, and half of the rise of the resistance, in one cycle. Each cell ages at its own rate."""
SHORTED_CELL = 4
"""Index of the cell with a short, from 0."""
SHORTS_OHM = (np.inf, 1000.0, 300.0, 100.0, 30.0, 10.0, 3.0, 1.0)
HEALTHY_CYCLES = 20
"""Number of cycles before a short appears."""
SAFETY = 1.2
"""Factor of a detector's threshold on its largest value in healthy packs."""
BALANCED_CELLS, BALANCED_AH, BALANCED_CYCLES = 6, 20.0, 12
"""Number of cells of a pack with a balancer, their capacity [Ah], and the number of its cycles."""
BALANCED_STEP_S, BALANCED_BLOCK = 10.0, 30
"""Interval of the samples of this pack [s], and the number of samples in a block."""
BALANCER_C = (0.0, 1 / 500, 1 / 200, 1 / 100, 1 / 50)
"""Currents of the balancers, as C-rates [1/h]."""
FULL_SOC, FULL_V = 0.98, {"nmc": 4.2, "lfp": 3.55}
"""Mean SOC at which a charge ends, and voltage of the highest cell at which it ends [V]."""
FULL_PACKS = 20
"""Number of healthy packs that are charged to full."""
CUSUM_SLACK = 1.0
"""Slack of the CUSUM in std of a cell's deviation."""


@dataclass(frozen=True)
class Hour:
    """Mean deviations of the cells in one hour, and the results of the estimators at its end."""

    time_h: float
    cycles: float
    """Number of cycles until then."""
    deviation_v: Floats
    """Voltage of each cell less the mean, mean over the hour [V], shape (cells,)."""
    cells_v: Floats
    """Voltages at the end of the hour [V]."""
    soc: Floats
    """True SOC of each cell."""
    short_c: Floats
    """Proven self-discharge of each cell, as a C-rate [1/h]."""
    reading_error_v: float
    z: Floats
    """Errors of the SOC deviations in std."""


def hours(chemistry: str, seed: int, cycles: int, short_ohm: float = np.inf) -> Iterator[Hour]:
    """Simulate a pack and yield each hour. A short appears after ``HEALTHY_CYCLES``."""
    rng = np.random.default_rng(seed)
    cell = load_cell(chemistry, CAPACITY_AH)
    drawn = BankCells.random(rng, CELLS, CAPACITY_AH, 0.9)
    drawn = replace(drawn, warmer_k=np.linspace(0.0, WARMER_K, CELLS))
    bank, rates = SimulatedBank(cell, drawn), np.exp(0.3 * rng.standard_normal(CELLS))
    estimator = Estimator(cell.pack(CELLS, 1), voltage_resolution_v=0.01, sampling=BOARD)
    estimators, offset_v = CellEstimator(estimator), OFFSET_V * rng.standard_normal(CELLS)
    direction, turns, block = 1.0, 0, 0
    deviations_v: list[Floats] = []
    while turns < 2 * cycles:
        mean = float(bank.soc.mean())
        before, direction = direction, 1.0 if mean > 0.85 else -1.0 if mean < 0.3 else direction
        turns += direction != before
        leaks = np.full(CELLS, np.inf)
        leaks[SHORTED_CELL] = short_ohm if turns >= 2 * HEALTHY_CYCLES else np.inf
        aged = np.exp(-AGING * turns / 2 * rates)
        bank.cells = replace(
            drawn, capacity_ah=drawn.capacity_ah * aged, ohm_factor=drawn.ohm_factor / aged**2, leak_ohm=leaks
        )
        noise_a = 0.3 * np.repeat(rng.standard_normal(2), round(300.0 / STEP_S))
        current_a = CAPACITY_AH * direction * 0.2 * np.maximum(1.0 + noise_a, 0.0)
        celsius = 22.0 + 8.0 * np.sin(2.0 * np.pi * block / (24 * BLOCKS))
        history = bank.run(current_a, STEP_S, celsius)
        noise_v = NOISE_V * rng.standard_normal(history.cell_v.shape)
        cells_v = np.round((history.cell_v + offset_v + noise_v) / RESOLUTION_V) * RESOLUTION_V
        samples = history.samples(rng, 2e-3, 0.01)
        estimators.run(samples, cells_v, estimator.run(samples))
        block += 1
        deviations_v.append((cells_v - cells_v.mean(axis=1, keepdims=True)).mean(axis=0))
        d = estimators.deviations
        if d is None or block % BLOCKS:
            continue
        true = bank.soc - bank.soc.mean()
        yield Hour(
            block / BLOCKS,
            turns / 2,
            np.mean(deviations_v[-BLOCKS:], axis=0),
            cells_v[-1],
            bank.soc,
            d.proven_self_discharge_a / CAPACITY_AH,
            float(d.reading_error_v.max()),
            (d.soc_deviation - true) / d.soc_deviation_std,
        )


def entropy_scores(course: list[Hour]) -> Floats:
    """Return the Shannon-entropy score of each hour: largest deviation of a cell's entropy over a day from the mean [nat]."""
    scores = np.zeros(len(course))
    for i in range(24, len(course)):
        voltages = np.array([hour.cells_v for hour in course[i - 24 : i]])
        entropy = np.array([_entropy(column) for column in voltages.T])
        # not divided by the std of the cells: that ratio cannot exceed the root of cells - 1, so no threshold would work
        scores[i] = np.abs(entropy - entropy.mean()).max()
    return scores


def _entropy(values: Floats) -> float:
    counts, _ = np.histogram(values, bins=12)
    share = counts[counts > 0] / values.size
    return float(-(share * np.log(share)).sum())


def difference_scores(course: list[Hour]) -> Floats:
    """Return the mean-difference score of each hour: largest change of a cell's mean deviation since the first days [V]."""
    deviation_v = np.array([hour.deviation_v for hour in course])
    return np.abs(deviation_v - deviation_v[:48].mean(axis=0)).max(axis=1)


def cusum_scores(course: list[Hour]) -> Floats:
    """Return the CUSUM of each hour: largest lower-sided sum over the cells, in std of the first days."""
    deviation_v = np.array([hour.deviation_v for hour in course])
    mean_v, std_v = deviation_v[:48].mean(axis=0), deviation_v[:48].std(axis=0)
    total, scores = np.zeros(deviation_v.shape[1]), np.zeros(len(course))
    for i, row in enumerate((mean_v - deviation_v) / std_v - CUSUM_SLACK):
        total = np.maximum(total + row, 0.0)
        scores[i] = total.max()
    return scores


DETECTORS: dict[str, Callable[[list[Hour]], Floats]] = {
    "entropy": entropy_scores,
    "mean difference": difference_scores,
    "CUSUM": cusum_scores,
}
"""Detectors of the field."""


def own_scores(course: list[Hour]) -> Floats:
    """Return the largest proven self-discharge relative to the limit of the alarm."""
    return np.array([hour.short_c.max() / MIN_SHORT_C for hour in course])


def delay_h(course: list[Hour], scores: Floats, threshold: float, begin: int) -> float:
    """Return the time from the short to the first score above ``threshold`` [h]; infinite without one."""
    late = [hour.time_h for hour, score in zip(course[begin:], scores[begin:], strict=True) if score >= threshold]
    return late[0] - course[begin].time_h if late else np.inf


def false_alarms(chemistry: str, cycles: int, seeds: int, first_seed: int) -> list[list[Hour]]:
    """Print the alarms of healthy packs. Return their courses."""
    courses = []
    shorts = readings = done = 0
    largest, squares, worst, began_s = -np.inf, [], 0.0, time.perf_counter()
    for seed in range(seeds):
        courses.append(list(hours(chemistry, first_seed + 1000 + seed, cycles // seeds)))
        for hour in courses[-1]:
            largest = max(largest, float(hour.short_c.max() / MIN_SHORT_C))
            shorts += bool((hour.short_c >= MIN_SHORT_C).any())
            readings += hour.reading_error_v >= MIN_READING_ERROR_V
            squares.append(float((hour.z**2).mean()))
            worst = max(worst, float(np.abs(hour.z).max()))
        done += cycles // seeds
    print_table(
        ("healthy packs", "value"),
        [
            ("chemistry, cycles, packs", f"{chemistry}, {done}, {seeds}"),
            ("hours with cell_short", str(shorts)),
            ("hours with cell_sensor_fault", str(readings)),
            ("largest proven self-discharge, of the limit", f"{largest:.2f}"),
            ("SOC deviation: RMS error, largest error [std]", f"{np.sqrt(np.mean(squares)):.2f}, {worst:.1f}"),
            ("duration [s]", f"{time.perf_counter() - began_s:.0f}"),
        ],
    )
    return courses


def delays(chemistry: str, healthy: list[list[Hour]], seeds: int, cycles: int, first_seed: int) -> None:
    """Print the detection delay of each short and detector.

    Args:
        chemistry: Name of a generic cell file.
        healthy: Courses of healthy packs, in which no detector may raise an alarm.
        seeds: Number of packs with each short.
        first_seed: First seed.
        cycles: Maximum number of cycles with a short of more than 50 ohm; others have a quarter of them.
    """
    thresholds = {name: SAFETY * max(score(course).max() for course in healthy) for name, score in DETECTORS.items()}
    rows = []
    for ohm in SHORTS_OHM:
        found: dict[str, list[float]] = {name: [] for name in ("cell_short", *DETECTORS)}
        for seed in range(seeds):
            limit = cycles if ohm > 50.0 else max(cycles // 4, 4)
            course = list(hours(chemistry, first_seed + 500 + seed, HEALTHY_CYCLES + limit, ohm))
            begin = next(i for i, hour in enumerate(course) if hour.cycles >= HEALTHY_CYCLES)
            found["cell_short"].append(delay_h(course, own_scores(course), 1.0, begin))
            for name, score in DETECTORS.items():
                found[name].append(delay_h(course, score(course), thresholds[name], begin))
        rows.append(("none" if np.isinf(ohm) else f"{ohm:g}", *(_hours_text(found[name]) for name in found)))
    print_table(("short [ohm]", "cell_short [h]", *(f"{name} [h]" for name in DETECTORS)), rows)


def balanced_scores(chemistry: str, seed: int, current_c: float, *, highest: bool) -> Floats:
    """Simulate a pack with a balancer. Return the largest proven self-discharge of each block, relative to the limit.

    The balancer is active while the pack does not discharge and a cell's voltage is above ``balancing_voltage_v``.

    Args:
        chemistry: Name of a generic cell file.
        seed: Seed of the random numbers.
        current_c: Current of the balancer, as a C-rate [1/h].
        highest: True if the balancer drains the cell with the highest SOC, False if it always drains the same cell.
    """
    rng, cell = np.random.default_rng(seed), load_cell(chemistry, BALANCED_AH)
    bank = SimulatedBank(cell, BankCells.random(rng, BALANCED_CELLS, BALANCED_AH, 0.9, soc_std=0.03))
    model = cell.pack(BALANCED_CELLS, 1)
    estimator = Estimator(model, voltage_resolution_v=0.01, sampling=BOARD)
    estimators, offset_v = CellEstimator(estimator), OFFSET_V * rng.standard_normal(BALANCED_CELLS)
    scores, highest_v, begin_v = list[float](), 0.0, balancing_voltage_v(model)

    def run(rate_c: float) -> None:
        nonlocal highest_v
        leaks = np.full(BALANCED_CELLS, np.inf)
        if rate_c <= 0.0 and highest_v >= begin_v and current_c:
            drained = int(np.argmax(bank.soc)) if highest else SHORTED_CELL
            leaks[drained] = begin_v / (current_c * BALANCED_AH)
        bank.cells = replace(bank.cells, leak_ohm=leaks)
        relative = max(1.0 + 0.3 * float(rng.standard_normal()), 0.0)
        history = bank.run(np.full(BALANCED_BLOCK, relative * rate_c * BALANCED_AH), BALANCED_STEP_S)
        noise_v = NOISE_V * rng.standard_normal(history.cell_v.shape)
        cells_v = np.round((history.cell_v + offset_v + noise_v) / RESOLUTION_V) * RESOLUTION_V
        samples = history.samples(rng, 2e-3, 0.01)
        estimators.run(samples, cells_v, estimator.run(samples))
        highest_v = float(cells_v[-1].max())
        if (d := estimators.deviations) is not None:
            scores.append(float(d.proven_self_discharge_a.max()) / (MIN_SHORT_C * BALANCED_AH))

    hour = round(3600.0 / (BALANCED_STEP_S * BALANCED_BLOCK))
    for _ in range(2 * hour):
        run(0.2)
    for _ in range(BALANCED_CYCLES):
        while bank.soc.mean() < FULL_SOC and highest_v < FULL_V[chemistry]:
            run(-0.2)
        for _ in range(hour):
            run(-0.002)
        for _ in range(3 * hour):
            run(0.2)
    return np.array(scores)


def full_packs(chemistry: str, first_seed: int) -> None:
    """Print the number of healthy packs without a balancer in which charging to full raises ``cell_short``."""
    scores = [balanced_scores(chemistry, first_seed + 2000 + seed, 0.0, highest=True) for seed in range(FULL_PACKS)]
    alarms = sum(bool((each >= 1.0).any()) for each in scores)
    rows = [("charged to full", str(BALANCED_CYCLES * FULL_PACKS), f"{alarms} of {FULL_PACKS}")]
    print_table(("healthy packs", "cycles", "packs with cell_short"), rows)


def balancers(chemistry: str, packs: int, first_seed: int) -> None:
    """Print the number of packs in which a balancer raises ``cell_short``."""
    rows = []
    for highest in (True, False):
        counts = []
        for current_c in BALANCER_C:
            scores = [
                balanced_scores(chemistry, first_seed + 100 + seed, current_c, highest=highest) for seed in range(packs)
            ]
            counts.append(f"{sum(bool((each >= 1.0).any()) for each in scores)} of {packs}")
        rows.append(("the cell with the highest SOC" if highest else "always one cell", *counts))
    header = ("none" if current_c == 0.0 else f"C/{1 / current_c:.0f}" for current_c in BALANCER_C)
    print_table(("the balancer drains", *header), rows)


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table."""
    table = Table(*map(escape, header))
    for row in rows:
        table.add_row(*map(escape, row))
    Console(width=110).print(table)


def _hours_text(delays_h: list[float]) -> str:
    return ", ".join("-" if np.isinf(each) else f"{each:.0f}" for each in delays_h)


def main(arguments: list[str]) -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chemistry", default="nmc", help="name of a generic cell file")
    parser.add_argument("--cycles", type=int, default=1000, help="cycles of healthy packs")
    parser.add_argument("--packs", type=int, default=5, help="number of healthy packs")
    parser.add_argument("--short-cycles", type=int, default=60, help="maximum number of cycles with a short")
    parser.add_argument("--short-packs", type=int, default=4, help="number of packs with each short")
    parser.add_argument(
        "--first-seed", type=int, default=20_000, help="first seed; the constants were chosen with --first-seed 0"
    )
    options = parser.parse_args(arguments)
    healthy = false_alarms(options.chemistry, options.cycles, options.packs, options.first_seed)
    full_packs(options.chemistry, options.first_seed)
    delays(options.chemistry, healthy, options.short_packs, options.short_cycles, options.first_seed)
    balancers(options.chemistry, options.packs, options.first_seed)


if __name__ == "__main__":
    main(sys.argv[1:])
