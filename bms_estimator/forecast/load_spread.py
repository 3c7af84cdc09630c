"""Uncertainty of the mean future load, from the variation of the observed load (method of batch means).

The mean current of a load varies from trip to trip. How far the future mean may differ from the observed one depends on the number
and the differences of the batches that were observed: a long homogeneous load has a narrow distribution, and two different trips
have a wide one.
"""

import math
from dataclasses import dataclass

import numpy as np

from bms_estimator.kernels.forecast.seen_load import MEAN_RUN_S
from bms_estimator.model.arrays import Floats

SHORT_BATCH_S, RUN_BATCH_S, TRIP_BATCH_S = 60, int(2.0 * MEAN_RUN_S), 1200
"""Lengths of the batches whose mean currents are compared [s]. The bootstrap with its mean run reproduces the variation of batches of
``RUN_BATCH_S``. ``TRIP_BATCH_S`` is the scale of a trip."""
PRIOR_DEGREES = 2
"""Degrees of freedom with which the variation of the shorter batches counts as the prior for that of the longer ones."""


@dataclass(frozen=True)
class LoadSpread:
    """Distribution of ln (mean future load / drawn load): Student's t distribution around 0.

    Attributes:
        std: Scale of the distribution.
        degrees: Degrees of freedom, above 0.
    """

    std: float
    degrees: float


def load_spread(current_a: Floats, horizon_s: float) -> LoadSpread:
    """Return the spread of the mean load over a horizon.

    The variance of the mean over t seconds is c / t. Its coefficient c is the product of the length of long batches and the
    variance of their means. Two errors are added: that of the observed mean, and the variation of the future mean that the
    bootstrap does not reproduce.

    Args:
        current_a: Current of each second [A], with a mean above 0.
        horizon_s: Time until the mean load has drawn the remaining charge [s].
    """
    short, _ = _coefficient(current_a, SHORT_BATCH_S)
    by_run, degrees = _coefficient(current_a, RUN_BATCH_S)
    run = _posterior(short, by_run, degrees)
    by_trip, degrees = _coefficient(current_a, TRIP_BATCH_S)
    trip = _posterior(run, by_trip, degrees)
    variance = trip / current_a.size + max(trip - run, 0.0) / (horizon_s + TRIP_BATCH_S)
    return LoadSpread(math.sqrt(variance) / float(current_a.mean()), float(PRIOR_DEGREES + degrees))


def _coefficient(current_a: Floats, batch_s: int) -> tuple[float, int]:
    """Return batch length times variance of the batch means [A^2 s], and its degrees of freedom. Both are 0 with one batch."""
    batches = current_a.size // batch_s
    if batches < 2:
        return 0.0, 0
    means_a = current_a[-batches * batch_s :].reshape(batches, batch_s).mean(axis=1)
    return batch_s * float(np.var(means_a, ddof=1)), batches - 1


def _posterior(prior: float, observed: float, degrees: int) -> float:
    """Return the mean of a prior with ``PRIOR_DEGREES`` and an observation, weighted by their degrees of freedom."""
    return (PRIOR_DEGREES * prior + degrees * observed) / (PRIOR_DEGREES + degrees)
