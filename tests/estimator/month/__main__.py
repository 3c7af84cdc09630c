"""Table of weeks of simulated use: ``python -m tests.estimator.month [filters] [--days N] [--seeds 1 2]``.

``python -m tests.estimator.month --summary`` writes the checked-in summary of some short runs, after an intended change of
the estimator.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from tests.conftest import SHARED_DATA
from tests.estimator.month import summary
from tests.estimator.month.cases import CASES, Case
from tests.estimator.month.packs import REAL_CAPTURES
from tests.estimator.month.run import run
from tests.estimator.month.store import save
from tests.estimator.month.table import header, line


def main() -> None:
    """Print a line for each run, or save the samples, or write the summary."""
    arguments = parse()
    if arguments.summary:
        summary.write(summary.table())
        write(str(summary.SUMMARY_PATH))
        return
    if not arguments.save:
        write(header(arguments.days))
    for case in chosen(arguments.filters, arguments.data):
        for seed in arguments.seeds:
            drawn = replace(case, days=arguments.days, seed=seed)
            if arguments.save:
                write(str(save(drawn, arguments.save, arguments.data)))
            else:
                write(line(drawn, run(drawn, arguments.data)))


def write(text: str) -> None:
    """Write a line at once, because a run takes many seconds."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def parse() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.estimator.month", description=__doc__)
    parser.add_argument("filters", nargs="*", help="parts of names; a case is run if its name contains all of them")
    parser.add_argument("--days", type=int, default=14)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument(
        "--save", type=Path, metavar="FOLDER", help="write samples and truth as .npz instead of the table"
    )
    parser.add_argument("--summary", action="store_true", help="write the checked-in summary instead of the table")
    parser.add_argument("--data", type=Path, default=SHARED_DATA, metavar="FOLDER", help="folder of the real captures")
    return parser.parse_args()


def chosen(filters: list[str], data: Path) -> Iterable[Case]:
    """Yield the cases whose name contains all filters. Cases without their captures are printed and left out."""
    for case in CASES:
        if not all(part in case.name for part in filters):
            continue
        if case.cell in REAL_CAPTURES and not data.is_dir():
            write(f"left out: {case.name}: {data} does not exist")
            continue
        yield case


main()
