"""Days until the query ``self-discharge`` finds an internal short in simulated packs, whose blocks a worker has processed.

``python -m tests.benchmarks.fleet.self_discharge [nmc|lfp]``; docs/fleet/questions.md.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank

CELLS, CAPACITY_AH, STEP_S, BLOCK = 12, 50.0, 30.0, 120
"""Number of cells, their capacity [Ah], the interval of the samples [s], and the number of samples of a block."""
NOISE_V, OFFSET_V, RESOLUTION_V, WARMER_K = 5e-4, 1e-3, 1e-3, 5.0
"""Noise of a reading, std of its offset, its resolution [V], and temperature of the last cell above the first one [K]."""
SHORTED_CELL, SHORT_DAY, DAYS = 4, 8, 32
"""Index of the cell with a short, day on which the short appears, and number of days."""
SHORTS_OHM = (np.inf, 1000.0, 300.0, 100.0, 30.0)
BEGIN_HOUR = 490_000 // 24 * 24
STORE_NS = BEGIN_HOUR * HOUR_S * 10**9


def hourly_rows(
    chemistry: str, seed: int, short_ohm: float, days: int = DAYS, short_day: int = SHORT_DAY
) -> list[Hour]:
    """Return the hourly rows of a simulated pack with a discharge, a rest and a charge each day."""
    rng, cell = np.random.default_rng(seed), load_cell(chemistry, CAPACITY_AH)
    drawn = replace(BankCells.drawn(rng, CELLS, CAPACITY_AH, 0.9), warmer_k=np.linspace(0.0, WARMER_K, CELLS))
    bank, offset_v = SimulatedBank(cell, drawn), OFFSET_V * rng.standard_normal(CELLS)
    settings = Settings(pack=PackSettings(cell=chemistry, capacity_ah=CAPACITY_AH, series=CELLS))
    model = cell.pack(CELLS, 1)
    partition, rows = Partition(0, lambda _: (settings, model)), list[Hour]()
    blocks_of_hour = round(HOUR_S / (STEP_S * BLOCK))
    for number in range(1, 24 * days * blocks_of_hour + 1):
        hour = (number - 1) // blocks_of_hour
        leaks = np.full(CELLS, np.inf)
        leaks[SHORTED_CELL] = short_ohm if hour >= 24 * short_day else np.inf
        bank.cells = replace(drawn, leak_ohm=leaks)
        history = bank.run(current_a(rng, hour, float(bank.soc.mean())), STEP_S, 22.0 + 8.0 * np.sin(hour * np.pi / 12))
        noise_v = NOISE_V * rng.standard_normal(history.cell_v.shape)
        cells_v = np.round((history.cell_v + offset_v + noise_v) / RESOLUTION_V) * RESOLUTION_V
        samples = history.samples(rng, 2e-3, 0.01)
        arrival_s = STORE_NS / 1e9 + float(samples["time_s"][-1])
        data = encode(Block(STORE_NS, number, 1, arrival_s, samples, cells_v))
        rows += [Hour.model_validate_json(row) for _, row in partition.take("pack", data, number).hours]
    return rows


def current_a(rng: np.random.Generator, hour: int, soc: float) -> np.ndarray:
    """Return the currents of a block: discharge until noon, then rest, charge from 18 h on [A]."""
    hour_of_day = hour % 24
    if 11 <= hour_of_day < 18 or (hour_of_day < 11 and soc < 0.25) or (hour_of_day >= 18 and soc > 0.9):
        return np.zeros(BLOCK)
    direction = 1.0 if hour_of_day < 11 else -1.9
    return CAPACITY_AH * direction * 0.055 * np.maximum(1.0 + 0.3 * rng.standard_normal(BLOCK), 0.0)


def first_reports(rows: Sequence[Sequence[Hour]]) -> list[tuple[str, float, float]]:
    """Return cell, day of the first report and its current [A] for each pack, as text, with ``-`` without a report."""
    reports: dict[str, tuple[str, float, float]] = {}
    with TemporaryDirectory() as folder:
        for day in range(DAYS):
            hours = range(BEGIN_HOUR + 24 * day, BEGIN_HOUR + 24 * (day + 1))
            write(
                Path(folder),
                [
                    row.model_copy(update={"pack": f"p{n}"})
                    for n, pack in enumerate(rows)
                    for row in pack
                    if row.hour in hours
                ],
            )
            for record in run_query(Path(folder), "self-discharge").records:
                reports.setdefault(record["pack"], (record["cell"], day - SHORT_DAY, record["self_discharge_ma"]))
    return [reports.get(f"p{n}", ("-", math.nan, math.nan)) for n in range(len(rows))]


def main() -> None:
    """Print for each pack the reported cell, the days from the short to the report, and the reported current."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("chemistry", nargs="?", default="nmc")
    parser.add_argument("--packs", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.packs)
    for short_ohm in SHORTS_OHM:
        rows = [hourly_rows(options.chemistry, seed, short_ohm) for seed in seeds]
        texts = [f"{cell} {days:.0f} d {ma:.1f} mA" for cell, days, ma in first_reports(rows)]
        sys.stdout.write(f"{options.chemistry} {short_ohm:g} ohm: {', '.join(texts)}\n")


if __name__ == "__main__":
    main()
