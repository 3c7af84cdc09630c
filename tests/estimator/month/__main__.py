"""Table of weeks of simulated use: ``python -m tests.estimator.month [filters] [--days N] [--seeds 1 2]``.

``--electrochemical`` selects cells that PyBaMM simulates. ``--summary`` writes the checked-in summary of some short runs, after
an intended change of the estimator, and ``--record`` the recordings of its electrochemical cells.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from tests.conftest import SHARED_DATA
from tests.estimator.month import electrochemical, summary
from tests.estimator.month.cases import CASES, Case
from tests.estimator.month.groups import GROUPS, group_score, mean_bound, title
from tests.estimator.month.packs import REAL_CAPTURES
from tests.estimator.month.run import Day, run


def main() -> None:
    """Print a line for each run, or save the samples, or write the summary."""
    arguments = parse()
    if arguments.summary:
        summary.write(summary.table())
        write(str(summary.SUMMARY_PATH))
        return
    if arguments.record:
        for recorded in electrochemical.RECORDED:
            recorded.record()
        return
    write(header(arguments.days))
    cases = electrochemical.CASES if arguments.electrochemical else CASES
    for case in chosen(cases, arguments.filters, arguments.data):
        for seed in arguments.seeds:
            drawn = replace(case, days=arguments.days, seed=seed)
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
    for name in ("--electrochemical", "--summary", "--record"):
        parser.add_argument(name, action="store_true")
    parser.add_argument("--data", type=Path, default=SHARED_DATA, metavar="FOLDER", help="folder of the real captures")
    return parser.parse_args()


def chosen(cases: Iterable[Case], filters: list[str], data: Path) -> Iterable[Case]:
    """Yield the cases whose name contains all filters. Cases without their captures are printed and left out."""
    for case in cases:
        if not all(part in case.name for part in filters):
            continue
        if case.cell in REAL_CAPTURES and not data.is_dir():
            write(f"left out: {case.name}: {data} does not exist")
            continue
        yield case


def header(days: int) -> str:
    """Return the lines above the results of ``days`` days."""
    columns = ["case", "seed", *(title(g) for g in GROUPS if g[0] <= days), "capacity / true"]
    return f"RMSE / inside / std / score (lower bound of the std) [%]\n\n{row(columns)}\n{row(['---'] * len(columns))}"


def line(case: Case, days: list[Day]) -> str:
    """Return the results of a run."""
    scores = [group_score(days, g) for g in GROUPS if g[0] <= case.days]
    bounds = [100.0 * mean_bound(days, g) for g in GROUPS if g[0] <= case.days]
    cells = [
        f"{s.rmse:.1f} / {s.cover:.0f} / {s.std:.1f} / {s.score:.1f} ({b:.1f})" if s else "-"
        for s, b in zip(scores, bounds, strict=True)
    ]
    last = days[-1]
    return row([case.name, str(case.seed), *cells, f"{last.capacity_ratio:.3f} +- {last.capacity_std:.3f}"])


def row(cells: list[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


main()
