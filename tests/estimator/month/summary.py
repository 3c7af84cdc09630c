"""Table of some short runs, under version control, so that a change of the estimator shows as a diff."""

import csv
from pathlib import Path

from tests.conftest import SHARED_DATA
from tests.estimator.month.cases import Case
from tests.estimator.month.electrochemical import RECORDED
from tests.estimator.month.groups import GROUPS, group_score, title
from tests.estimator.month.run import run
from tests.estimator.month.sources import SOLAR
from tests.fit_interval import fits_every

SUMMARY_PATH = Path(__file__).with_name("summary.csv")
SMALL_CASES = (
    Case("LG M50", "never_full", days=3),
    Case("Leaf", "full_nightly", days=2),
    Case("LFP", "full_weekly", days=4),
    Case("LFP", "solar", SOLAR, declared_ah=20.0, days=4),
    Case("LG M50", "bicycle", days=7),
    *RECORDED,
)
"""Cases of the summary. They need no captures from outside the repository."""
FIT_INTERVAL_S = 12.0 * 3600.0
"""Minimum interval between two slow fits [s]. The fits take most of the time of the cases."""
COLUMNS = ("case", "days", "rmse", "cover", "std", "score")
DIGITS = 2
"""Decimal digits of the table."""
TOLERANCE = 0.02
"""Tolerance of the numbers [%], which are rounded to 0.01. The functions exp and log differ in the last bit between processors;
a change of every voltage by 1e-9 V changes the numbers by at most 0.001."""

Table = dict[tuple[str, str], tuple[float, ...]]
"""RMSE, share inside two std, std and score [%] by case and days."""


def table(cases: tuple[Case, ...] = SMALL_CASES) -> Table:
    """Run the cases and return their results."""
    results: Table = {}
    for case in cases:
        with fits_every(FIT_INTERVAL_S):
            days = run(case, SHARED_DATA)
        scores = {title(g): group_score(days, g) for g in GROUPS if g[0] <= case.days}
        results |= {(case.name, name): (s.rmse, s.cover, s.std, s.score) for name, s in scores.items() if s is not None}
    return results


def write(results: Table, path: Path = SUMMARY_PATH) -> None:
    """Write a table."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([*key, *(f"{v:.{DIGITS}f}" for v in values)] for key, values in results.items())


def read(path: Path = SUMMARY_PATH) -> Table:
    """Read a table."""
    with path.open() as file:
        return {(line[0], line[1]): tuple(map(float, line[2:])) for line in list(csv.reader(file))[1:]}


def changes(results: Table, expected: Table) -> list[str]:
    """Return a line for each number that differs from the expected one, and for each row that only one table has."""
    lines = [f"{', '.join(key)}: in one table only" for key in results.keys() ^ expected.keys()]
    for key in results.keys() & expected.keys():
        for name, value, before in zip(COLUMNS[2:], results[key], expected[key], strict=True):
            if abs(value - before) > TOLERANCE:
                lines.append(f"{', '.join(key)} {name}: {value:.3f}, was {before:.2f}")
    return sorted(lines)
