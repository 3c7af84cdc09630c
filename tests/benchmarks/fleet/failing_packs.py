"""Packs that the query ``failing`` must name, and healthy ones that it must not: 12 days of 16 simulated packs in a worker.

Run ``make bank``, or ``python -m tests.benchmarks.fleet.failing_packs``. A pack takes some 5 s of one core.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, encode
from bms_estimator.fleet.hour_row import HOUR_S, Hour
from bms_estimator.fleet.queries.duckdb_queries import run_query
from bms_estimator.fleet.queries.parquet_files import write
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.model.cell import load_cell
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank
from tests.fleet.hour_rows import BEGIN

DAYS = 12
CAPACITY_AH, STEP_S, BLOCK = 50.0, 30.0, 20
"""Capacity of a cell [Ah], interval of the samples [s], and number of samples of a block."""
NOISE_V, OFFSET_V, LARGE_OFFSET_V, RESOLUTION_V = 5e-4, 1e-3, 5e-3, 1e-3
"""Noise of a reading, std of its offset, this std in the packs with offsets, and its resolution [V]."""
WARMER_K = 5.0
"""Temperature of the last cell above the first one [K]."""
FAULTY_CELL = 4
"""Number of the faulty cell, from 1."""
BALANCER_OHM, BALANCED_V = 40.0, 0.01
"""Resistor of the passive balancer, and voltage above the lowest cell at which it is switched on [V]."""
STORE_NS = BEGIN * HOUR_S * 10**9


@dataclass(frozen=True)
class Chemistry:
    """Cells in series, with the voltages of a cell at which a charge ends, a discharge ends and the balancer begins [V]."""

    series: int
    full_v: float
    cutoff_v: float
    balancer_v: float


CHEMISTRIES = {"nmc": Chemistry(12, 4.2, 3.0, 4.1), "lfp": Chemistry(16, 3.6, 2.6, 3.4)}


@dataclass(frozen=True)
class Variant:
    """Properties of a pack that differ from those of a healthy one."""

    capacity_ratio: float = 1.0
    ohm_factor: float = 1.0
    leak_ohm: float = np.inf
    soc_below: float = 0.0
    """The properties of the faulty cell."""
    offset_v: float = OFFSET_V
    has_balancer: bool = False

    @property
    def is_healthy(self) -> bool:
        """True if no cell is faulty."""
        return replace(self, offset_v=OFFSET_V, has_balancer=False) == Variant()


VARIANTS = {
    "healthy": Variant(),
    "offsets": Variant(offset_v=LARGE_OFFSET_V),
    "balancer": Variant(has_balancer=True),
    "85-percent": Variant(capacity_ratio=0.85),
    "70-percent": Variant(capacity_ratio=0.7),
    "resistance": Variant(ohm_factor=1.8),
    "short": Variant(leak_ohm=100.0),
    "low": Variant(soc_below=0.1),
}
"""Variants by name."""


def rows_of_pack(chemistry: str, variant: str, days: int = DAYS, seed: int = 0) -> Iterator[Hour]:
    """Yield the hourly rows of a pack, with a discharge, a rest and a charge each day.

    Args:
        chemistry: Name in ``CHEMISTRIES``.
        variant: Name in ``VARIANTS``.
        days: Number of days.
        seed: Seed of the random values.
    """
    c, v, name = CHEMISTRIES[chemistry], VARIANTS[variant], f"{chemistry}-{variant}"
    rng, cell = np.random.default_rng([seed, *name.encode()]), load_cell(chemistry, CAPACITY_AH)
    drawn = BankCells.random(rng, c.series, CAPACITY_AH, 0.9).with_weak_cell(
        FAULTY_CELL - 1, capacity_ratio=v.capacity_ratio, soc_below=v.soc_below
    )
    drawn.warmer_k[:] = np.linspace(0.0, WARMER_K, c.series)
    drawn.ohm_factor[FAULTY_CELL - 1] *= v.ohm_factor
    drawn.leak_ohm[FAULTY_CELL - 1] = v.leak_ohm
    bank = SimulatedBank(cell, drawn, full_v=c.full_v * c.series, cutoff_v=c.cutoff_v * c.series)
    offset_v, last_v = v.offset_v * rng.standard_normal(c.series), np.full(c.series, 0.5 * (c.full_v + c.cutoff_v))
    settings = Settings(pack=PackSettings(name=name, cell=chemistry, capacity_ah=CAPACITY_AH, series=c.series))
    model = cell.pack(c.series, 1)
    partition = Partition(0, lambda _: (settings, model))
    blocks_of_hour, is_empty, is_full = round(HOUR_S / (STEP_S * BLOCK)), False, False
    for number in range(1, 24 * days * blocks_of_hour + 1):
        hour = (number - 1) // blocks_of_hour % 24
        is_empty = (is_empty or last_v.min() < c.cutoff_v) and hour < 18
        is_full = (is_full or last_v.max() > c.full_v + 0.03) and hour >= 18
        if v.has_balancer:
            hot = (last_v > c.balancer_v) & (last_v > last_v.min() + BALANCED_V)
            bank.cells = replace(drawn, leak_ohm=np.where(hot, BALANCER_OHM, np.inf))
        history = bank.run(
            _current_a(rng, hour, is_empty=is_empty, is_full=is_full), STEP_S, 22.0 + 8.0 * np.sin(hour * np.pi / 12)
        )
        last_v = history.cell_v[-1]
        noise_v = NOISE_V * rng.standard_normal(history.cell_v.shape)
        cells_v = np.round((history.cell_v + offset_v + noise_v) / RESOLUTION_V) * RESOLUTION_V
        samples = history.samples(rng, 2e-3, 0.01)
        arrival_s = STORE_NS / 1e9 + float(samples["time_s"][-1])
        data = encode(Block(STORE_NS, number, 1, arrival_s, samples, cells_v))
        for _, row in partition.process(name, data, number, round(arrival_s)).hours:
            yield Hour.model_validate_json(row)


def _current_a(rng: np.random.Generator, hour: int, *, is_empty: bool, is_full: bool) -> NDArray[np.float64]:
    """Return the currents of a block: discharge until 11 h, then rest, charge from 18 h on [A]."""
    if 11 <= hour < 18 or (is_empty and hour < 11) or is_full:
        return np.zeros(BLOCK)
    if hour >= 18:
        return np.full(BLOCK, -0.145 * CAPACITY_AH)
    return 0.06 * CAPACITY_AH * np.maximum(1.0 + 0.3 * rng.standard_normal(BLOCK), 0.0)


def main() -> None:
    """Simulate all packs and print the answer of the query for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    seed, wrong = parser.parse_args().seed, 0
    with tempfile.TemporaryDirectory() as folder:
        for chemistry in CHEMISTRIES:
            for variant in VARIANTS:
                write(Path(folder), rows_of_pack(chemistry, variant, seed=seed))
        records = run_query(Path(folder), "failing").records
    for chemistry in CHEMISTRIES:
        for variant, v in VARIANTS.items():
            found = [each for each in records if each["pack"] == f"{chemistry}-{variant}"]
            # an alarm names no cell
            is_right = not found if v.is_healthy else {each["cell"] for each in found} - {None} == {FAULTY_CELL}
            wrong += not is_right
            texts = [
                each["quantity"]
                if each["cell"] is None
                else f"{each['quantity']} of cell {each['cell']} {each['value']:.3g}"
                for each in found
            ]
            sys.stdout.write(
                f"{'ok   ' if is_right else 'WRONG'} {chemistry} {variant}: {', '.join(texts) or 'none'}\n"
            )
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
