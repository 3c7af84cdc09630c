"""Uncertainty of the mean future load, from the variation of the observed load (method of batch means).

The mean current of a load varies from trip to trip. How far the future mean may differ from the observed one depends on the number
and the differences of the batches that were observed: a long homogeneous load has a narrow distribution, and two different trips
have a wide one.
"""

import math
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import Floats

BATCHES_S = 60, 300, 1200
"""Lengths of the batches whose mean currents are compared [s]. The last one is the scale of a trip."""
PRIOR_DEGREES = 2
"""Degrees of freedom with which the variation of shorter batches counts as the prior for that of longer ones."""


@dataclass(frozen=True)
class LoadSpread:
    """Distribution of ln (mean future load / drawn load): Student's t distribution around 0.

    Attributes:
        std: Scale of the distribution.
        degrees: Degrees of freedom, above 0.
    """

    std: float
    degrees: float


def load_spread(current_a: Floats) -> LoadSpread:
    """Return the spread of the mean load: the standard error of the observed mean, divided by this mean.

    The variance of the mean over t seconds is c / t. The coefficient c is the length of a batch times the variance of the means of
    batches, provided that the batches are independent. Each length of batches contributes with its degrees of freedom.

    Args:
        current_a: Current of each second [A], with a mean above 0.
    """
    coefficient, degrees = _coefficient(current_a, BATCHES_S[0])
    for batch_s in BATCHES_S[1:]:
        observed, degrees = _coefficient(current_a, batch_s)
        coefficient = (PRIOR_DEGREES * coefficient + degrees * observed) / (PRIOR_DEGREES + degrees)
    std = math.sqrt(coefficient / current_a.size) / float(current_a.mean())
    return LoadSpread(std, float(PRIOR_DEGREES + degrees))


def _coefficient(current_a: Floats, batch_s: int) -> tuple[float, int]:
    """Return batch length times variance of the batch means [A^2 s], and its degrees of freedom. Both are 0 with one batch."""
    batches = current_a.size // batch_s
    if batches < 2:
        return 0.0, 0
    means_a = current_a[-batches * batch_s :].reshape(batches, batch_s).mean(axis=1)
    return batch_s * float(np.var(means_a, ddof=1)), batches - 1
