"""Gain of earlier discharges with a similar load: ``python -m tests.benchmarks.forecast.routes [--seeds N]``.

A simulated cell is driven twice a day and charged at night, for eight days. Each two minutes of the ninth day, forecasts with and
without the earlier days are compared with the true time to the cut-off.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.estimator.estimator import new_estimator
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.forecast.forecast import Forecast
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.past_minutes import COMPARED_MINUTES, MINUTE_S, PastMinutes
from bms_estimator.kernels.cell_model.chen_mora import cell_step, ocv, r_s
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import load_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock
from bms_estimator.settings.pack import PackSettings, Settings

Kind = Literal["route", "detour", "random"]
"""Days: the same two routes; the same with a detour of 20 min on 30 % of the ways back; other routes each day."""
CELL, CUTOFF_V, FULL_SOC = load_cell("ncr18650"), 2.7, 0.95
ONE_C_A = CELL.cell.capacity_ah
DAYS = 8
DRIVE_MINUTES, REST_S, STEP_S = 45, 600, 120
NOISE, DAY_NOISE, RANDOM_LEVEL = 0.2, 0.08, 0.3
"""Std of ln current: of each second, of each drive, and of the mean of a random route."""


@dataclass(frozen=True)
class Score:
    """Score of a forecast against the true time: interval score and error of the median, relative to the true time."""

    interval: float
    error: float
    covers: bool


def route(rng: np.random.Generator, minutes: int = DRIVE_MINUTES, level: float = 1.0) -> Floats:
    """Return the current of each second of a route [A], constant for 10 s."""
    smooth = np.convolve(rng.normal(size=6 * minutes + 23), np.full(24, 24**-0.5), "valid")
    return np.repeat(0.45 * ONE_C_A * level * np.exp(0.8 * smooth - 0.3), 10)


def days(rng: np.random.Generator, kind: Kind, count: int) -> Iterator[list[Floats]]:
    """Yield the currents of the two drives of each day [A]."""
    out, back = route(rng), route(rng)
    for _ in range(count):
        if kind == "random":
            out, back = (route(rng, level=np.exp(RANDOM_LEVEL * rng.normal())) for _ in range(2))
        with_detour = kind == "detour" and rng.random() < 0.3
        way_back = np.concatenate([back[:1200], route(rng, 20), back[1200:]]) if with_detour else back
        yield [
            drive * np.exp(NOISE * rng.normal(size=drive.size) + DAY_NOISE * rng.normal()) for drive in (out, way_back)
        ]


def simulate(rng: np.random.Generator, kind: Kind) -> tuple[SampleBlock, int]:
    """Return the samples until the cut-off on the last day, and the index of this day's first sample."""
    state, rows, grid = (FULL_SOC, 0.0, 0.0), list[tuple[float, float]](), ocv_grid(CELL)

    def step(current_a: float) -> float:
        nonlocal state
        state = cell_step(state, current_a, 1.0, 3600.0 * ONE_C_A, CELL.a)
        rows.append((current_a, ocv(state[0], *grid) - state[1] - state[2] - current_a * r_s(state[0], CELL.a)))
        return rows[-1][1]

    *past, last, after = days(rng, kind, DAYS + 2)
    for day in past:
        for drive in day:
            any(step(current_a) <= CUTOFF_V for current_a in [*drive, *np.zeros(REST_S)])
        while state[0] < FULL_SOC:
            step(-0.7 * ONE_C_A)
        for _ in range(REST_S):
            step(0.0)
    begin = len(rows)
    any(step(current_a) <= CUTOFF_V for drive in [*last, *after, *last] for current_a in [*drive, *np.zeros(REST_S)])
    samples = np.zeros(len(rows), SAMPLE)
    samples["time_s"], samples["temperature_c"] = np.arange(len(rows)), 25.0
    samples["current_a"], samples["voltage_v"] = np.array(rows).T
    samples["voltage_v"] += 1e-3 * rng.normal(size=len(rows))
    return samples, begin


def score(forecast: Forecast, true_s: float) -> Score:
    """Return the score of a forecast with a 90 % interval."""
    names = "time_to_cutoff_p05_s", "time_to_cutoff_s", "time_to_cutoff_p95_s"
    low_s, median_s, high_s = (float(forecast.values[0][name]) for name in names)
    missed_s = max(low_s - true_s, true_s - high_s, 0.0)
    return Score(
        (high_s - low_s + 2.0 / 0.1 * missed_s) / true_s, abs(median_s - true_s) / true_s, low_s <= true_s <= high_s
    )


def scores(seed: int, kind: Kind) -> Iterator[tuple[int, Score, Score]]:
    """Yield the number of similar earlier loads, and the scores without and with them."""
    samples, begin = simulate(np.random.default_rng([seed, 7]), kind)
    estimator = new_estimator(Settings(pack=PackSettings(initial_soc=FULL_SOC)), CELL)
    forecaster = Forecaster(estimator, estimator, cutoff_v=CUTOFF_V)
    for part in np.array_split(samples[:begin], begin // 600):
        forecaster.run_without_forecast(part)
    for end in range(begin + STEP_S, samples.size - STEP_S, STEP_S):
        forecaster.run_without_forecast(samples[end - STEP_S : end])
        if end - begin < (COMPARED_MINUTES + 2) * MINUTE_S or samples["current_a"][end - 1] == 0.0:
            continue
        past, true_s = forecaster.past, float(samples.size - end)
        with_past = forecaster.forecast()
        forecaster.past = PastMinutes()
        without = forecaster.forecast()
        forecaster.past = past
        if with_past.reason is None:
            yield (
                len(past.analogues(forecaster.load.seconds // MINUTE_S)),
                score(without, true_s),
                score(with_past, true_s),
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    seeds = parser.parse_args().seeds
    table = Table("days", "moments", "similar loads", "interval score / T", "median error", "in the 90 % band")
    for kind in get_args(Kind):
        rows = [row for seed in range(seeds) for row in scores(seed, kind)]
        found, *both = zip(*rows, strict=True)
        columns = (
            [f"{np.mean([s.interval for s in each]):.2f}" for each in both],
            [f"{np.median([s.error for s in each]):.2f}" for each in both],
            [f"{np.mean([s.covers for s in each]):.2f}" for each in both],
        )
        table.add_row(kind, str(len(rows)), f"{np.mean(found):.1f}", *(" -> ".join(column) for column in columns))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
