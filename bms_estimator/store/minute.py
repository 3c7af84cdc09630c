"""A minute of a pack: means, extremes and sums of its publications. Pure."""

import math
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

from bms_estimator.model.payloads import Estimate

MINUTE_S = 60
MAX_S = 30.0
"""Longest interval between two publications that is not a gap; over a gap no charge is counted [s]."""
GAP_RATIO = 3.0
"""An interval counts as a gap if it is this many times as long as the one before, so that a slow source has none."""


class Minute(NamedTuple):
    """One row of history; None for missing values. Means and extremes are over published values."""

    time_s: int
    """Beginning of the minute [s since 1970]."""
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
    """The last, 0..1."""
    soc_std: float | None
    charge_out_ah: float
    charge_in_ah: float
    energy_out_wh: float
    energy_in_wh: float
    seen_s: float
    """Measured part of the minute [s]."""
    publications: int


@dataclass
class _Mean:
    """Mean of one quantity."""

    count: int = 0
    total: float = 0.0
    least: float = math.inf
    most: float = -math.inf

    def add(self, value: float | None) -> None:
        if value is not None:
            self.count += 1
            self.total += value
            self.least, self.most = min(self.least, value), max(self.most, value)

    @property
    def values(self) -> tuple[float, float, float]:
        return self.total / self.count, self.least, self.most


@dataclass
class MinuteAccumulator:
    """The open minute; ``time_s`` is its begin [s since 1970]."""

    time_s: int
    _voltage: _Mean = field(default_factory=_Mean)
    _current: _Mean = field(default_factory=_Mean)
    _temperature: _Mean = field(default_factory=_Mean)
    _last: Estimate | None = None
    _charge_as: list[float] = field(default_factory=lambda: [0.0, 0.0])  # out, in
    _energy_ws: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _seen_s: float = 0.0

    def add(self, estimate: Estimate, seen_s: float) -> None:
        """Take a publication; ``seen_s`` is the time since the one before, as ``seen`` has it [s]."""
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
        charge_out, charge_in = (each / 3600.0 for each in self._charge_as)
        energy_out, energy_in = (each / 3600.0 for each in self._energy_ws)
        measured = *self._voltage.values, *self._current.values
        temperature = self._temperature.values if self._temperature.count else (None, None, None)
        sums = charge_out, charge_in, energy_out, energy_in, self._seen_s, self._voltage.count
        return Minute._make((self.time_s, *measured, *temperature, self._last.soc, self._last.soc_std, *sums))


def seen(span_s: float, before_s: float) -> float:
    """Return the measured part of the time between two publications [s]: nothing of a gap.

    Args:
        span_s: Time between the two on the board's clock [s].
        before_s: Time between the previous two [s].
    """
    return span_s if 0.0 < span_s <= max(MAX_S, GAP_RATIO * before_s) else 0.0


def epoch_s(time: str) -> float:
    """Seconds since 1970 of a published time."""
    return datetime.fromisoformat(time).timestamp()


def minute_of(epoch: float) -> int:
    """Begin of the minute [s since 1970]."""
    return int(epoch // MINUTE_S) * MINUTE_S
