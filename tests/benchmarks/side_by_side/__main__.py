"""Comparison of methods on real captures. Each method learns from one load profile and is evaluated on others.

``make compare`` runs all trials, ``make compare ARGS="NCR PF"`` those whose name contains a word, and ``--json`` prints each
figure in place of tables. docs/theory/comparison.md tells what is measured and how.
"""

import json
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict
from itertools import repeat
from pathlib import Path

from rich.console import Console

from tests.benchmarks.recipes import DATA, cell_file
from tests.benchmarks.side_by_side.measure import Bench, Figure, Reference, measure_trial, step_costs
from tests.benchmarks.side_by_side.tables import figure_tables, reference_table, seed_table
from tests.benchmarks.side_by_side.trials import TRIALS, chosen

TIMED_TRIALS = (TRIALS[0], TRIALS[2])
"""Trials in which the time of a step is measured: one at 1 Hz, one at 10 Hz."""


def main() -> None:
    """Print the tables."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    trials = chosen([word for word in sys.argv[1:] if not word.startswith("--")])
    figures: list[Figure] = []
    references: list[Reference] = []
    with tempfile.TemporaryDirectory() as folder:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            # Compute all cell files, which ``cell_file`` then finds in the folder.
            list(pool.map(cell_file, {trial.recipe for trial in trials}, repeat(Path(folder))))
        with ProcessPoolExecutor() as pool:
            for reference, trial_figures in pool.map(measure_trial, trials, repeat(Path(folder))):
                references.append(reference)
                figures += trial_figures
        for trial in TIMED_TRIALS:
            bench = Bench(trial, Path(folder))
            figures += step_costs(bench.starts[0][1], bench.first.samples, trial.name)
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps([asdict(figure) for figure in figures]) + "\n")
        return
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(reference_table(references))
    for table in figure_tables(figures):
        console.print(table)
    console.print(seed_table(figures))


if __name__ == "__main__":
    main()
