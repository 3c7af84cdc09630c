"""Observed load: second by second since the last long charge, minute by minute of past discharges, and both as saved arrays.

The mean current of a load varies from trip to trip. The method of batch means estimates how far the future mean may differ from
the observed one: a long homogeneous load has a narrow distribution, and two different trips have a wide one. Past discharges are
searched for analogues: loads like the present one.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.trip import GivenLoad
from bms_estimator.kernels.forecast.load_seconds import LOAD, MAX_LOAD_S, add_rows, copy_seconds
from bms_estimator.kernels.kalman_filter.ekf import CHARGE_C
from bms_estimator.kernels.kalman_filter.window import REST_C
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.unmeasured_time import UNMEASURED_S

BATCHES_S = 60, 300, 1200
"""Lengths of the batches whose mean currents are compared [s]. The last one is the scale of a trip."""
PRIOR_DEGREES = 2
"""Degrees of freedom of the prior for longer batches, which is the variation of shorter ones."""


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

    The variance of the mean over t seconds is c / t. For independent batches, the coefficient c is the length of a batch times
    the variance of the batch means. Each length of batches contributes with its degrees of freedom.

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
    """Return batch length times variance of the batch means [A^2 s], and its degrees of freedom; both 0 for one batch."""
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


MINUTE_S = 60
"""Length of a minute [s]."""
MAX_MINUTES = 20_000
"""Maximum number of stored minutes: a year with 55 minutes of use a day."""
COMPARED_MINUTES = 20
"""Length of the latest load that is compared with earlier ones [min]."""
MAX_DIFFERENCE = 0.25
"""Maximum difference of an analogue from the latest load: mean absolute difference, relative to the mean of the latest load."""
MIN_AHEAD_MINUTES = 30
"""Minimum length of the load that followed an analogue [min]. A forecast uses that load as the future one."""
MAX_ANALOGUES = 10
"""Maximum number of analogues. If there are more, the most similar ones are used."""
PEAK_S = 5.0
"""Assumed duration of the largest current of a minute [s]. Only the current itself is stored."""


class PastMinutes:
    """Mean and largest current of each minute that ``LoadHistory`` stores, also of discharges before the last charge.

    Attributes:
        mean_a: Mean current of each minute [A], oldest first, positive on discharge.
        max_a: Largest current of each minute [A].
    """

    def __init__(self) -> None:
        self.mean_a: Floats = np.zeros(0)
        self.max_a: Floats = np.zeros(0)
        self._next = 0  # index in the ring buffer of ``LoadHistory``: first second not yet added

    def add(self, load: LoadHistory) -> None:
        """Add the complete minutes of a load since the previous call."""
        end = int(load.record["next"][0])
        new = min((end - self._next) % MAX_LOAD_S, load.seconds)
        minutes = new // MINUTE_S
        if minutes == 0:
            return
        mean_a, max_a = (column[load.seconds - new :][: minutes * MINUTE_S] for column in load.mean_and_max())
        self._next = (end - new + minutes * MINUTE_S) % MAX_LOAD_S
        self.mean_a = np.append(self.mean_a, mean_a.reshape(-1, MINUTE_S).mean(axis=1))[-MAX_MINUTES:]
        self.max_a = np.append(self.max_a, max_a.reshape(-1, MINUTE_S).max(axis=1))[-MAX_MINUTES:]

    def restore(self, mean_a: Floats, max_a: Floats, load: LoadHistory) -> None:
        """Restore saved minutes, which already include the seconds of ``load``."""
        self.mean_a, self.max_a, self._next = mean_a, max_a, int(load.record["next"][0])

    def analogues(self, present_minutes: int) -> list[GivenLoad]:
        """Return the loads that followed the analogues in earlier discharges, the load after the most similar one first.

        Args:
            present_minutes: Number of the last minutes that belong to the present discharge.
        """
        earlier_minutes = self.mean_a.size - present_minutes
        if present_minutes < COMPARED_MINUTES or earlier_minutes < COMPARED_MINUTES + MIN_AHEAD_MINUTES:
            return []
        present = self.mean_a[-COMPARED_MINUTES:]
        windows = np.lib.stride_tricks.sliding_window_view(
            self.mean_a[: earlier_minutes - MIN_AHEAD_MINUTES], COMPARED_MINUTES
        )
        difference = np.abs(windows - present).mean(axis=1) / max(float(np.abs(present).mean()), 1e-9)
        ends = list[int]()
        while len(ends) < MAX_ANALOGUES and difference.min() <= MAX_DIFFERENCE:
            best = int(difference.argmin())
            ends.append(best + COMPARED_MINUTES)
            # a window that overlaps this one is not another analogue
            difference[max(best - COMPARED_MINUTES, 0) : best + COMPARED_MINUTES] = np.inf
        return [self._load_after(end) for end in ends]

    def _load_after(self, end: int) -> GivenLoad:
        """Return the load from the minute ``end`` on. Each minute has its mean, and its largest current for ``PEAK_S``."""
        mean_a, max_a = self.mean_a[end:], self.max_a[end:]
        others_a = (mean_a * MINUTE_S - max_a * PEAK_S) / (MINUTE_S - PEAK_S)
        current_a = np.stack([others_a, max_a], axis=1).ravel()
        duration_s = np.tile([MINUTE_S - PEAK_S, PEAK_S], mean_a.size)
        return GivenLoad(duration_s, current_a, np.full(current_a.size, np.nan))


MAX_CURRENT_A = 1e6
"""Maximum plausible absolute current [A]."""
MAX_REST_S = 1e10
"""Maximum plausible duration of a rest [s]: 300 years."""

SCALARS = "filtered_a", "last_a", "rest_s", "seen_discharge_a", "seen_charge_a"
"""Saved fields of ``LOAD`` that are numbers."""


def load_arrays(load: LoadHistory, past: PastMinutes) -> dict[str, NDArray[Any]]:
    """Return the load as arrays by name, for ``restore_load``."""
    row = load.record[0]
    mean_a, max_a = load.mean_and_max()
    return {
        "mean_a": mean_a.astype(np.float32),
        "max_a": max_a.astype(np.float32),
        **{name: np.array(row[name]) for name in SCALARS},
        "minutes_mean_a": past.mean_a.astype(np.float32),
        "minutes_max_a": past.max_a.astype(np.float32),
    }


def restore_load(load: LoadHistory, past: PastMinutes, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Restore a load.

    Arrays that an earlier version saved lack the largest currents, which are then 0.

    Args:
        load: Empty load to fill; unchanged if the arrays are invalid.
        past: Empty minutes to fill; unchanged if the arrays are invalid.
        arrays: Arrays of ``load_arrays``.

    Raises:
        ValueError: An array is missing, or has another shape or implausible values.
    """
    arrays = {"seen_discharge_a": np.array(0.0), "seen_charge_a": np.array(0.0), **arrays}
    missing = [name for name in load_arrays(load, past) if name not in arrays]
    if missing:
        raise ValueError(f"{', '.join(missing)}: missing")
    mean_a, max_a, scalars = arrays["mean_a"], arrays["max_a"], [arrays[name] for name in SCALARS]
    minutes_mean_a, minutes_max_a = arrays["minutes_mean_a"], arrays["minutes_max_a"]
    for mean, largest, max_size in ((mean_a, max_a, MAX_LOAD_S), (minutes_mean_a, minutes_max_a, MAX_MINUTES)):
        if mean.ndim != 1 or mean.shape != largest.shape or mean.size > max_size or any(v.ndim for v in scalars):
            raise ValueError(
                f"arrays of shapes {mean.shape} and {largest.shape}: must be equal, with at most {max_size} elements"
            )
    for values in (mean_a, max_a, minutes_mean_a, minutes_max_a, *scalars):
        limit = MAX_REST_S if values is arrays["rest_s"] else MAX_CURRENT_A
        if values.dtype.kind not in "fi" or not (np.abs(values) <= limit).all():
            raise ValueError("a value is not finite, or too large")
    if arrays["rest_s"] < 0:
        raise ValueError("the duration of the rest is negative")
    row = load.record[0]
    for name in SCALARS:
        row[name] = arrays[name]
    row["count"], row["next"] = mean_a.size, mean_a.size % MAX_LOAD_S
    row["mean_a"][: mean_a.size], row["max_a"][: mean_a.size] = mean_a, np.maximum(mean_a, max_a)
    past.restore(minutes_mean_a.astype(float), np.maximum(minutes_mean_a, minutes_max_a).astype(float), load)
