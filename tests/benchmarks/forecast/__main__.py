"""Forecasts of the time to the cut-off on real captures, beside other methods.

Each discharge is replayed through the estimator and the forecaster. Every minute before the cut-off the forecast is compared
with the true time to the cut-off T, in the last two hours also with other methods. docs/theory/forecast-figures.md defines the
figures.
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

from tests.benchmarks.forecast.ablation import PARTS, outcomes_without_parts
from tests.benchmarks.forecast.captures import OWN, Case, cases, other_cases
from tests.benchmarks.forecast.measure import outcomes_of_discharge
from tests.benchmarks.forecast.moments import INTERVAL_S
from tests.benchmarks.forecast.scores import Outcome
from tests.benchmarks.forecast.simulations import SIMULATIONS, Simulation, simulate_discharge
from tests.benchmarks.forecast.tables import ablation_tables, tables
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
    for table in ablation_tables(found, [part.name for part in PARTS]) if options.ablation else tables(found):
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
    if options.ablation:
        yield from outcomes_without_parts(case, discharge, cell, options.interval)
    else:
        has_baselines = not options.no_baselines and case.file == OWN
        yield from outcomes_of_discharge(case, discharge, cell, options.interval, has_baselines=has_baselines)


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
    made.add_argument("--no-baselines", action="store_true", help="run only the forecast")
    made.add_argument("--ablation", action="store_true", help="run the forecast without one of its parts at a time")
    made.add_argument("--json", action="store_true", help="print each outcome instead of tables")
    return made


if __name__ == "__main__":
    main()
