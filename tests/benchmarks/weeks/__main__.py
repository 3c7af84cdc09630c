"""Ablation study of the slow fit over simulated weeks: ``make ablation-weeks``.

Each run disables one part of the slow fit, of its anchors or of its hand-over. An entry of the table has four values in %:
RMSE of the SOC, fraction of time within two std, mean std, and interval score. They are means over the days of the second half
of each run, over the cases of a kind, and over the seeds.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tests.benchmarks.weeks.parts import PARTS
from tests.benchmarks.weeks.runs import score_without
from tests.conftest import SHARED_DATA
from tests.estimator.anywhere.score import Score
from tests.estimator.month.cases import CURRENT_TOO_HIGH, FAST, OXIDES, PHOSPHATES, VOLTAGE_TOO_HIGH, Case
from tests.estimator.month.groups import mean_score
from tests.estimator.month.packs import REAL_CAPTURES
from tests.estimator.month.sources import BMS, SOLAR, SPLIT

KINDS: dict[str, tuple[Case, ...]] = {
    "oxides, never full": tuple(Case(cell, "never_full") for cell in OXIDES),
    "oxides, full weekly": tuple(Case(cell, "full_weekly") for cell in OXIDES),
    "LFP, never full": tuple(Case(cell, "never_full") for cell in PHOSPHATES),
    "LFP, full weekly": tuple(Case(cell, "full_weekly") for cell in PHOSPHATES),
    "solar": tuple(Case("LFP", use, SOLAR, declared_ah=20.0) for use in ("solar", "solar_full_weekly")),
    "bicycle": tuple(Case(cell, "bicycle") for cell in ("LG M50", "PF")),
    "boat": (Case("LG M50", "boat"), Case("LFP", "boat")),
    "emptied weekly": (Case("LG M50", "empty_weekly"), Case("LFP", "empty_weekly")),
    "BMS": tuple(Case(cell, "full_weekly", BMS) for cell in ("LG M50", "PF", "A123")),
    "split topics": (Case("PF", "full_weekly", SPLIT), Case("NCR", "never_full", SPLIT, "own")),
    "gain errors": tuple(
        Case(cell, use, source, file)
        for source in (VOLTAGE_TOO_HIGH, CURRENT_TOO_HIGH)
        for cell, use, file in (("PF", "full_weekly", "generic"), ("NCR", "never_full", "own"))
    ),
    "aging": (Case("LG M50", "full_nightly", aging=FAST),),
}
"""Cases by kind. A kind is named by its cells, its use or its source."""
Scores = dict[tuple[str, str], list[Score]]
"""Scores by part and kind."""


def main() -> None:
    """Print the table of the chosen kinds and parts."""
    options = parse()
    kinds = {name: cases for name, cases in KINDS.items() if matches(name, options.kinds)}
    parts = [name for name in PARTS if matches(name, options.parts)]
    results: Scores = {}
    for kind, cases in kinds.items():
        for case in cases_of_seeds(cases, options):
            add_scores(results, kind, case, parts, options.data)
    sys.stdout.write("RMSE / inside / std / score [%]\n\n")
    sys.stdout.writelines(f"| {' | '.join(line)} |\n" for line in lines(results, list(kinds), parts))


def parse() -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(prog="make ablation-weeks", description=__doc__)
    parser.add_argument("kinds", nargs="*", help=f"beginnings of names of kinds; default: all of {', '.join(KINDS)}")
    parser.add_argument("--parts", nargs="+", default=[], help="beginnings of names of parts; default: all")
    parser.add_argument("--days", type=int, default=14)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--data", type=Path, default=SHARED_DATA, metavar="FOLDER", help="folder of the real captures")
    return parser.parse_args()


def matches(name: str, beginnings: list[str]) -> bool:
    """Return True if a name begins with one of ``beginnings``, or if there are none."""
    return not beginnings or any(name.startswith(beginning) for beginning in beginnings)


def cases_of_seeds(cases: tuple[Case, ...], options: argparse.Namespace) -> Iterator[Case]:
    """Yield each case with each seed. Cases without their captures are reported and left out."""
    for case in cases:
        if case.cell in REAL_CAPTURES and not options.data.is_dir():
            report(f"left out: {case.name}: {options.data} does not exist")
            continue
        for seed in options.seeds:
            yield replace(case, days=options.days, seed=seed)


def add_scores(results: Scores, kind: str, case: Case, parts: list[str], data: Path) -> None:
    """Simulate a case once, run the estimator over it without each of the parts, and add the scores."""
    recording = case.draw(data)
    for part in parts:
        result = score_without(case, recording, PARTS[part], case.days // 2 + 1)
        if result is not None:
            results.setdefault((part, kind), []).append(result)
        report(f"{case.name}, seed {case.seed}, without {part}: {entry([] if result is None else [result])}")


def lines(results: Scores, kinds: list[str], parts: list[str]) -> Iterator[list[str]]:
    """Yield the cells of each line of the table in Markdown."""
    yield ["without", *kinds]
    yield ["---"] * (1 + len(kinds))
    for part in parts:
        yield [part, *(entry(results.get((part, kind), [])) for kind in kinds)]


def entry(scores: list[Score]) -> str:
    """Return the mean of scores as text."""
    s = mean_score(scores)
    return "-" if s is None else f"{s.rmse:.2f} / {s.cover:.0f} / {s.std:.1f} / {s.score:.1f}"


def report(text: str) -> None:
    """Write a line of progress at once, because a run takes many seconds."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
