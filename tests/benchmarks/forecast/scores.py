"""Scores of forecasts of the time to the cut-off, and the conditions by which they are grouped."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import Floats

OUTSIDE = 2.0 / 0.1
"""Weight of the distance outside a 90 % interval in its interval score."""
LEVELS = np.array([0.05, 0.5, 0.95])
"""Levels of the quantiles of a forecast."""
MIN_QUANTILE_S = 1.0
"""Minimum of a quantile of which the logarithm is taken [s]."""
MINUTE_S = 60.0
INTERVAL_S = 60.0
"""Interval between two forecasts, by default [s]."""


class Quantiles(NamedTuple):
    """Quantiles of the time to the cut-off [s]; NaN if unknown."""

    p05_s: float
    p50_s: float
    p95_s: float


@dataclass(frozen=True)
class Outcome:
    """Forecast, and what came true."""

    capture: str
    file: str
    """Kind of the cell file."""
    load: str
    """Kind of the load."""
    is_phosphate: bool
    temperature_c: float
    """Temperature when the discharge begins [C]."""
    knows_temperature: bool
    """True if the cell file was measured at this temperature, too."""
    rate_c: float
    """Mean current before the cut-off, as a C-rate."""
    truth_s: float
    """True time to the cut-off [s]."""
    said: Quantiles
    """Forecast."""


Condition = Callable[[Outcome], bool]
"""Function that returns True for the outcomes of a group."""


@dataclass(frozen=True)
class Score:
    """Scores of some forecasts. Times are divided by the true time to the cut-off T."""

    count: int
    error: float
    """Median of |median - T| / T."""
    inside: float
    """Fraction with T inside the 90 % band."""
    early: float
    """Fraction with T before the 5 % quantile."""
    interval: float
    """Median of the interval score of the 90 % band / T."""
    mean_interval: float
    """Mean of the interval score / T."""
    pinball: float
    """Mean pinball loss of ln of the three quantiles. It is a proper score, and no single forecast decides it."""


def score(outcomes: Iterable[Outcome]) -> Score | None:
    """Return the scores of the outcomes; None if there are none."""
    rows = np.array([(o.truth_s, *o.said) for o in outcomes]).reshape(-1, 4)
    if not rows.size:
        return None
    truth_s, low_s, median_s, high_s = rows.T
    early_s, late_s = np.maximum(low_s - truth_s, 0.0), np.maximum(truth_s - high_s, 0.0)
    interval = (high_s - low_s + OUTSIDE * (early_s + late_s)) / truth_s
    return Score(
        truth_s.size,
        float(np.median(np.abs(median_s - truth_s) / truth_s)),
        float(np.mean((early_s == 0.0) & (late_s == 0.0))),
        float(np.mean(early_s > 0.0)),
        float(np.median(interval)),
        float(np.mean(interval)),
        pinball_loss(np.log(truth_s), np.log(np.maximum(rows[:, 1:], MIN_QUANTILE_S))),
    )


def pinball_loss(truth: Floats, quantiles: Floats) -> float:
    """Return the mean pinball loss of the quantiles ``LEVELS``. Shapes (n,) and (n, 3)."""
    above = truth[:, None] - quantiles
    return float(np.mean(np.maximum(LEVELS * above, (LEVELS - 1.0) * above)))


def said_between(low_min: float, high_min: float) -> Condition:
    """Return the condition that the median of the forecast lies in this range [min]."""
    return lambda o: low_min * MINUTE_S <= o.said.p50_s < high_min * MINUTE_S


def lead(*seconds: float) -> Condition:
    """Return the condition that the cut-off comes in one of these times [s], as closely as the moments lie."""
    return lambda o: any(abs(o.truth_s - s) < 0.5 * INTERVAL_S for s in seconds)
