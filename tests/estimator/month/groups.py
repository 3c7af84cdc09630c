"""Scores of groups of days."""

from collections.abc import Iterable
from dataclasses import astuple

import numpy as np

from tests.estimator.anywhere.score import Score
from tests.estimator.month.run import Day

GROUPS = ((1, 1), (2, 3), (4, 7), (8, 14), (15, 30), (31, 60), (61, 98))
"""First and last day of each group."""


def title(group: tuple[int, int]) -> str:
    """Return the days of a group in words."""
    first, last = group
    return f"day {first}" if first == last else f"days {first}-{last}"


def mean_score(scores: Iterable[Score]) -> Score | None:
    """Return the mean of scores with equal weights (RMSE: of the squares); None without scores."""
    rows = np.array([astuple(s) for s in scores])
    if not rows.size:
        return None
    return Score(float(np.sqrt(np.mean(rows[:, 0] ** 2))), *map(float, rows[:, 1:].mean(axis=0)))


def group_score(days: Iterable[Day], group: tuple[int, int]) -> Score | None:
    """Return the score of the days of a group; None if none of them is scored."""
    return mean_score(day.score for day in days if group[0] <= day.number <= group[1] and day.score is not None)


def mean_bound(days: Iterable[Day], group: tuple[int, int]) -> float:
    """Return the mean of the lower bound of the std over the scored days of a group; NaN if none of them is scored."""
    bounds = [day.bound for day in days if group[0] <= day.number <= group[1] and day.score is not None]
    return float(np.mean(bounds)) if bounds else float("nan")
