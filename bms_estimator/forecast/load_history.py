"""Observed load since the last long charge, second by second, and the uncertainty of its future mean.

The mean current of a load varies from trip to trip. How far the future mean may differ from the observed one depends on the number
and the differences of the batches that were observed: a long homogeneous load has a narrow distribution, and two different trips
have a wide one. This is the method of batch means.
"""

import math
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.kernels.forecast.load_seconds import LOAD, add_rows, copy_seconds
from bms_estimator.kernels.kalman_filter.current_offset import REST_C
from bms_estimator.kernels.kalman_filter.ekf import CHARGE_C
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.unmeasured_time import UNMEASURED_S

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


class LoadHistory:
    """Mean and largest current of each second since the last long charge, in a buffer of constant size.

    Args:
        capacity_as: Capacity of the pack [A s].
        unmeasured_s: Longest step over which the current counts as measured [s].

    Attributes:
        record: Shape (1,), dtype ``LOAD``: the complete state, which can be copied, saved and restored.
    """

    def __init__(self, capacity_as: float, unmeasured_s: float = UNMEASURED_S) -> None:
        self.record: Records = np.zeros(1, LOAD)
        self._one_c_a, self._unmeasured_s = capacity_as / 3600.0, unmeasured_s

    def add(self, trace: TraceBlock) -> None:
        """Add rows of dtype ``TRACE``."""
        add_rows(self.record[0], trace, self._unmeasured_s, self._one_c_a)

    @property
    def seconds(self) -> int:
        """Number of stored seconds."""
        return int(self.record["count"][0])

    @property
    def rest_s(self) -> int:
        """Duration of the present rest [s]."""
        return int(self.record["rest_s"][0])

    @property
    def is_charging(self) -> bool:
        """True during a long charge, False during regeneration, which is shorter."""
        row = self.record[0]
        return bool(row["filtered_a"] < -CHARGE_C * self._one_c_a and row["last_a"] < -REST_C * self._one_c_a)

    @property
    def seen_a(self) -> tuple[float, float]:
        """Largest mean currents of a second so far [A], at least 0: of discharge and of charge."""
        row = self.record[0]
        return float(row["seen_discharge_a"]), float(row["seen_charge_a"])

    @property
    def mean_a(self) -> Floats:
        """Mean current of each second [A], oldest first, positive on discharge."""
        return self.mean_and_max()[0]

    @property
    def max_a(self) -> Floats:
        """Largest current of each second [A]."""
        return self.mean_and_max()[1]

    def mean_and_max(self) -> tuple[Floats, Floats]:
        """Return mean and largest current of each second [A], oldest first."""
        mean_a, max_a = np.empty(self.seconds), np.empty(self.seconds)
        copy_seconds(self.record[0], mean_a, max_a)
        return mean_a, max_a
