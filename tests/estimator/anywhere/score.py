"""Scores of an estimated SOC with its standard deviation."""

from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats

MAX_WEIGHT_S = 60.0
"""Maximum weight of a sample, so that a long gap does not dominate the score [s]."""
LOWEST_SOC = 0.05
"""True SOC below which samples are not scored."""
MIN_SAMPLES = 10
"""Minimum number of scored samples."""


@dataclass(frozen=True)
class Score:
    """Scores of one run, weighted by time. All except ``nees`` are in percent of SOC or of the time."""

    rmse: float
    bias: float
    cover: float
    """Share of time with the true SOC inside soc +- 2 soc_std [%]."""
    std: float
    """Mean of soc_std [%]."""
    score: float
    """Interval score of soc +- 2 soc_std as a 95 % interval, by Gneiting and Raftery (2007), equation 43.

    It is the width of the interval, plus 40 (2 / 0.05) times the distance of a true SOC outside.
    """
    nees: float
    """Mean of (error / soc_std)^2; 1 for a correct std."""


def score(time_s: Floats, soc: Floats, soc_std: Floats, truth: Floats, after_s: float = 900.0) -> Score | None:
    """Score a run from ``after_s`` on, above ``LOWEST_SOC``. Arrays of shape (n,).

    Returns:
        None if too few samples remain.
    """
    judged = (time_s - time_s[0] >= after_s) & (truth >= LOWEST_SOC)
    weight = np.clip(np.diff(time_s, append=time_s[-1]), 0.0, MAX_WEIGHT_S)[judged]
    if judged.sum() < MIN_SAMPLES or weight.sum() == 0.0:
        return None
    weight /= weight.sum()
    error, std = (soc - truth)[judged], soc_std[judged]
    # distance of the true SOC from the interval
    beyond = np.clip(np.abs(error) - 2.0 * std, 0.0, None)
    means = np.array([error**2, error, beyond == 0.0, std, 4.0 * std + 40.0 * beyond, (error / std) ** 2]) @ weight
    return Score(100.0 * np.sqrt(means[0]), *(100.0 * means[1:5]), means[5])
