"""One-minute row of a pack: means, extremes and sums of its publications. No I/O."""

import math
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

from bms_estimator.model.payloads.estimate import Estimate

MINUTE_S = 60
"""Length of a minute [s]."""
MAX_INTERVAL_S = 30.0
"""Maximum interval between two publications that is never a gap [s]. No charge is counted over a gap."""
GAP_RATIO = 3.0
"""Maximum ratio of an interval to the previous interval that is not a gap, so that a slow source has no gaps."""


class Minute(NamedTuple):
    """Row of the history; missing values are None. Means and extremes are taken over the published values."""

    time_s: int
    """Start of the minute [s since 1970]."""
    voltage_v: float
    voltage_min_v: float
    voltage_max_v: float
    current_a: float
    """Positive on discharge."""
    current_min_a: float
    current_max_a: float
    temperature_c: float | None
    temperature_min_c: float | None
    temperature_max_c: float | None
    soc: float | None
    """Last published SOC, 0..1."""
    soc_std: float | None
    charge_out_ah: float
    charge_in_ah: float
    energy_out_wh: float
    energy_in_wh: float
    seen_s: float
    """Measured part of the minute [s]."""
    publications: int


@dataclass
class _Statistics:
    """Mean and extremes of one quantity."""

    count: int = 0
    total: float = 0.0
    minimum: float = math.inf
    maximum: float = -math.inf

    def add(self, value: float | None) -> None:
        if value is not None:
            self.count += 1
            self.total += value
            self.minimum, self.maximum = min(self.minimum, value), max(self.maximum, value)

    @property
    def values(self) -> tuple[float, float, float]:
        """Mean, minimum and maximum."""
        return self.total / self.count, self.minimum, self.maximum


@dataclass
class MinuteAccumulator:
    """Accumulator of the open minute, which starts at ``time_s`` [s since 1970]."""

    time_s: int
    _voltage: _Statistics = field(default_factory=_Statistics)
    _current: _Statistics = field(default_factory=_Statistics)
    _temperature: _Statistics = field(default_factory=_Statistics)
    _last: Estimate | None = None
    _charge_as: list[float] = field(default_factory=lambda: [0.0, 0.0])  # out and in [A s]
    _energy_ws: list[float] = field(default_factory=lambda: [0.0, 0.0])  # out and in [W s]
    _seen_s: float = 0.0

    def add(self, estimate: Estimate, seen_s: float) -> None:
        """Add a publication. ``seen_s`` is the measured time since the previous publication [s]; see ``measured_time``."""
        self._voltage.add(estimate.voltage_v)
        self._current.add(estimate.current_a)
        self._temperature.add(estimate.temperature_c)
        self._last = estimate
        self._seen_s += seen_s
        self._charge_as[estimate.current_a < 0.0] += abs(estimate.current_a) * seen_s
        self._energy_ws[estimate.power_w < 0.0] += abs(estimate.power_w) * seen_s

    def row(self) -> Minute | None:
        """Return the row of the minute; None if nothing was published."""
        if self._last is None:
            return None
        charge_out, charge_in = (charge_as / 3600.0 for charge_as in self._charge_as)
        energy_out, energy_in = (energy_ws / 3600.0 for energy_ws in self._energy_ws)
        voltage_and_current = *self._voltage.values, *self._current.values
        temperature = self._temperature.values if self._temperature.count else (None, None, None)
        publications = self._voltage.count
        sums = charge_out, charge_in, energy_out, energy_in, self._seen_s, publications
        return Minute._make(
            (self.time_s, *voltage_and_current, *temperature, self._last.soc, self._last.soc_std, *sums)
        )


def measured_time(interval_s: float, previous_interval_s: float) -> float:
    """Return the time between two publications [s], or 0 if the time is a gap or the clock went back.

    Args:
        interval_s: Time between the two publications on the board's clock [s].
        previous_interval_s: Time between the previous two publications [s].
    """
    return interval_s if 0.0 < interval_s <= max(MAX_INTERVAL_S, GAP_RATIO * previous_interval_s) else 0.0


def epoch_s(time: str) -> float:
    """Convert a published time to seconds since 1970."""
    return datetime.fromisoformat(time).timestamp()


def minute_start(time_s: float) -> int:
    """Return the start of the minute that contains a time [s since 1970]."""
    return int(time_s // MINUTE_S) * MINUTE_S
