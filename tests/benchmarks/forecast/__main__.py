"""Forecasts of the time to the cut-off on real captures.

Each discharge is replayed through the estimator and the forecaster. Every minute before the cut-off the forecast is compared
with the true time to the cut-off T. docs/theory/forecast.md defines the figures.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path

from rich.console import Console

from tests.benchmarks.forecast.captures import Case, cases, other_cases
from tests.benchmarks.forecast.measure import outcomes_of_discharge
from tests.benchmarks.forecast.scores import INTERVAL_S, Outcome
from tests.benchmarks.forecast.simulations import SIMULATIONS, Simulation, simulate_discharge
from tests.benchmarks.forecast.tables import tables
from tests.benchmarks.forecast.truth import read_discharge
from tests.benchmarks.recipes import Recipe, cell_file


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    options = parser().parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        of_cases = (run(case, Path(folder), options) for case in chosen(options))
        found = list(chain.from_iterable(of_cases))
    if options.json:
        sys.stdout.write(json.dumps([asdict(outcome) for outcome in found]) + "\n")
        return
    console = Console(width=None if sys.stdout.isatty() else 200)
    for table in tables(found):
        if table.row_count:
            console.print(table)


def run(case: Case | Simulation, folder: Path, options: argparse.Namespace) -> Iterator[Outcome]:
    """Yield the outcomes of a case; none if its capture is not a discharge. Cell files are computed in ``folder``."""
    if isinstance(case, Simulation):
        discharge, cell = simulate_discharge(case)
        case = case.case
    else:
        found = read_discharge(case)
        if found is None:
            return
        discharge, cell = found, cell_file(case.recipe, folder)
    yield from outcomes_of_discharge(case, discharge, cell, options.interval)


def chosen(options: argparse.Namespace) -> Iterator[Case | Simulation]:
    """Yield the cases and simulations that the options choose."""
    if options.data is not None:
        recipe = Recipe(options.capacity_ah, generic=options.cell) if options.cell else None
        yield from other_cases(options.data, options.words, recipe)
        return
    yield from cases(options.words)
    yield from (s for s in SIMULATIONS if not options.words or any(word in s.name for word in options.words))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options."""
    made = argparse.ArgumentParser(prog="make forecast", description=__doc__)
    made.add_argument("words", nargs="*", help="parts of the names of the cases to run; default: all")
    made.add_argument("--data", type=Path, help="folder of other captures, CELL/CAPTURE.csv.gz")
    made.add_argument(
        "--cell",
        help="cell file, or name of a cell, for the captures of --data; default: by the name of the folder CELL",
    )
    made.add_argument("--capacity-ah", type=float, default=3.0, help="capacity of this cell [Ah]; default: %(default)g")
    made.add_argument(
        "--interval", type=float, default=INTERVAL_S, help="time between two forecasts [s]; default: %(default)g"
    )
    made.add_argument("--json", action="store_true", help="print each outcome instead of tables")
    return made


if __name__ == "__main__":
    main()
