"""Methods side by side on real captures: each learns from one profile and is judged on others.

``make compare``, or some of the trials: ``make compare ARGS="NCR PF"``; with ``--json`` the figures one by one. What is
measured and how is in docs/theory/comparison.md.
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
from tests.benchmarks.side_by_side.measure import Bench, Figure, Reference, of_trial, step_costs
from tests.benchmarks.side_by_side.tables import figure_tables, reference_table, seed_table
from tests.benchmarks.side_by_side.trials import TRIALS, chosen

TIMED = (TRIALS[0], TRIALS[2])
"""At 1 and at 10 Hz."""


def main() -> None:
    """Print the tables."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    trials = chosen([word for word in sys.argv[1:] if not word.startswith("--")])
    figures: list[Figure] = []
    references: list[Reference] = []
    with tempfile.TemporaryDirectory() as folder:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(cell_file, {trial.recipe for trial in trials}, repeat(Path(folder))))
        with ProcessPoolExecutor() as pool:
            for reference, found in pool.map(of_trial, trials, repeat(Path(folder))):
                references.append(reference)
                figures += found
        for trial in TIMED:
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
