"""Samples from voltages and currents that change at different times, with values held between the changes."""

from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import Floats
from bms_estimator.model.sample import SampleStatus
from bms_estimator.sources.captures.tables.layout import RawBlock, Role

SETTLE_S = 0.5
"""Maximum time between the voltage and the current of one sample [s], the default of an MQTT source."""
MAX_SILENT_S = 3600.0
"""Maximum pause of both values in which they are repeated [s]. In a longer pause the recording probably stopped."""
MAX_HELD_S = 86_400.0
"""Maximum time for which a value holds while the other one changes [s]."""
REPEAT_PERIODS = 1.5
"""Time without a change after which the values are repeated, in periods of the recording."""
MIN_REPEAT_S = 5.0
"""Minimum interval of repeated values [s], to limit their number. Longer intervals would be gaps in a fast recording."""
PERIOD_QUANTILE = 0.1
"""Quantile of the times between two changes that estimates the period. A value often stays the same for several periods."""
MIN_STEPS = 20
"""Minimum number of steps of the current that determine its period. With fewer, the steps of the voltage count too."""
MIN_PERIOD_S, MAX_PERIOD_S = 0.1, 60.0
"""Range of the period [s]. Longer steps are those of a value that rarely changes."""


class TimedValues(NamedTuple):
    """Values of a quantity at the times at which they changed."""

    time_s: Floats
    """Times [s], increasing."""
    value: Floats
    """Values from these times on; NaN from the time at which the value became unavailable."""

    def index_at(self, times_s: Floats) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Return the number of changes up to and including each time."""
        return np.searchsorted(self.time_s, times_s, side="right")

    def at(self, times_s: Floats) -> Floats:
        """Return the value at each time; NaN before the first one, and later than ``MAX_HELD_S`` after a change."""
        index = self.index_at(times_s)
        since_s: Floats = np.concatenate([[-np.inf], self.time_s])[index]
        value: Floats = np.concatenate([[np.nan], self.value])[index]
        return np.where(times_s - since_s <= MAX_HELD_S, value, np.nan)


def assemble(voltage: TimedValues, current: TimedValues, temperature: TimedValues | None) -> RawBlock:
    """Return a sample at each change of voltage or current, in the units of the values.

    A voltage and a current within ``SETTLE_S`` of each other belong to one sample. A sample with only a new current is marked as
    having a held voltage. A sample with only a new voltage has the last current. It is marked as having a held current if the
    current changes within a period, because the change may have been earlier than its record. An unchanged current is
    repeated, with a held voltage, until one period before its next change, so that its charge counts. There are no samples
    while voltage or current is unavailable, and no repeated ones in a pause longer than ``MAX_SILENT_S``.
    """
    period_s = _period(voltage, current)
    changes_s = _sample_times(voltage, current)
    has_voltage, has_current = (np.diff(series.index_at(changes_s), prepend=0) > 0 for series in (voltage, current))
    repeats_s = _repeat_times(voltage, current, changes_s, period_s)
    time_s = np.concatenate([changes_s, repeats_s])
    absent = np.zeros(repeats_s.size, dtype=bool)
    new_voltage, new_current = (np.concatenate([has, absent]) for has in (has_voltage, has_current))
    next_current = np.append(current.time_s, np.inf)[current.index_at(time_s)]
    status = np.where(new_voltage, 0, SampleStatus.VOLTAGE_HELD)
    status[new_voltage & ~new_current & (next_current - time_s <= period_s)] = SampleStatus.CURRENT_HELD
    block: RawBlock = {
        Role.TIME: time_s,
        Role.VOLTAGE: voltage.at(time_s),
        Role.CURRENT: current.at(time_s),
        Role.STATUS: status.astype(np.float64),
    }
    if temperature is not None:
        block[Role.TEMPERATURE] = temperature.at(time_s)
    order = np.argsort(time_s, kind="stable")
    kept = order[np.isfinite(block[Role.VOLTAGE][order]) & np.isfinite(block[Role.CURRENT][order])]
    return {role: values[kept] for role, values in block.items()}


def _period(voltage: TimedValues, current: TimedValues) -> float:
    """Return the period at which the recorded device measures the current [s]."""
    steps_s = np.diff(current.time_s)
    if steps_s.size < MIN_STEPS:
        steps_s = np.concatenate([steps_s, np.diff(voltage.time_s)])
    period_s = float(np.quantile(steps_s, PERIOD_QUANTILE)) if steps_s.size else MIN_PERIOD_S
    return min(max(period_s, MIN_PERIOD_S), MAX_PERIOD_S)


def _sample_times(voltage: TimedValues, current: TimedValues) -> Floats:
    """Return the times of samples with a change [s]. A change waits up to ``SETTLE_S`` for one of the other quantity."""
    times = []
    for series, other in ((voltage, current), (current, voltage)):
        next_s = np.append(other.time_s, np.inf)[other.index_at(series.time_s)]
        times.append(np.where(next_s - series.time_s <= SETTLE_S, next_s, series.time_s))
    return np.unique(np.concatenate(times))


def _repeat_times(voltage: TimedValues, current: TimedValues, changes_s: Floats, period_s: float) -> Floats:
    """Return the times at which an unchanged current is repeated [s]."""
    if changes_s.size == 0:
        return changes_s
    before_s, after_s = changes_s[:-1], changes_s[1:]
    before_a = current.at(before_s)
    holds = np.isfinite(before_a) & np.isfinite(voltage.at(before_s)) & (after_s - before_s <= MAX_SILENT_S)
    ends = (current.at(after_s) != before_a) | ~np.isfinite(voltage.at(after_s))
    last_s = after_s - period_s
    interval_s = max(REPEAT_PERIODS * period_s, MIN_REPEAT_S)
    counts = np.where(holds, np.ceil((last_s - before_s) / interval_s).clip(min=1.0) - 1.0, 0.0).astype(np.int64)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    confirmed = holds & ends & (last_s - before_s > 0.5 * period_s)
    return np.concatenate([np.repeat(before_s, counts) + number * interval_s, last_s[confirmed]])
