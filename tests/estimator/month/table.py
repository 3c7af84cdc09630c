"""Table of the results, in Markdown."""

from tests.estimator.month.cases import Case
from tests.estimator.month.groups import GROUPS, group_score, mean_bound, title
from tests.estimator.month.run import Day


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
