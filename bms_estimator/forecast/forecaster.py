"""Forecasts of a pack, at intervals on the clock of the samples."""

import math
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np

from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.estimator.estimator import Estimator, TraceBlock
from bms_estimator.forecast.available_power import (
    Forecast,
    ForecastCurve,
    ForecastRows,
    PowerLimits,
    PresentPower,
    cell_power_limits,
    raise_to_present,
    unknown_values,
)
from bms_estimator.forecast.capability import projected_pack, write_capability
from bms_estimator.forecast.load_history import MINUTE_S, LoadHistory, PastMinutes, load_spread
from bms_estimator.forecast.projection import (
    Projection,
    discharges,
    project_given_load,
    project_observed_load,
    project_until_load_end,
    time_quantiles,
)
from bms_estimator.forecast.trip import GivenLoad
from bms_estimator.model.arrays import Floats, Records

MIN_INTERVAL_S = 10.0
"""Minimum interval between two forecasts, on the clock of the samples [s]. It limits the CPU time near the cut-off."""
MAX_INTERVAL_S = 120.0
"""Maximum interval between two forecasts [s]."""
RETRY_S = 30.0
"""Retry interval if no forecast could be made [s]."""
INTERVAL_FRACTION = 1.0 / 60.0
"""Interval between two forecasts as a fraction of the median time to the cut-off, within the limits above."""
MIN_LOAD_S = 300
"""Minimum length of the observed load for a forecast [s]."""
MAX_REST_S = 900
"""Duration of a rest after which the next load is assumed to be unlike the observed one [s]."""
_HASH_FACTOR = 0x9E3779B97F4A7C15
"""Factor of Fibonacci hashing, 2**64 over the golden ratio: seeds of adjacent samples differ in many bits."""
_SEED_COUNT = 2**64


class Forecaster:
    """Forecasts from the state of an estimator and the observed load.

    The times of the forecasts and their random numbers depend on the samples alone.

    Args:
        estimator: Estimator of the pack; read only.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        limits: Limits of the available power; None: the limits of the cell file.

    Attributes:
        load: Load observed since the last long charge.
        past: Load of this and earlier discharges, minute by minute.
        latest: The last forecast.
        deviations: Deviations of the single cells; None without cell voltages.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        cutoff_v: float,
        limits: PowerLimits | None = None,
    ) -> None:
        self.estimator, self.cutoff_v = estimator, cutoff_v
        self._limits = limits or cell_power_limits(estimator.cell)
        filter_settings = estimator.cell_file_settings
        self.load = LoadHistory(float(filter_settings["capacity_as"]), float(filter_settings["unmeasured_s"]))
        self.past = PastMinutes()
        self.latest = Forecast(math.nan, unknown_values(), "no sample has been processed yet", None)
        self.deviations: CellDeviations | None = None
        self._due_s = -math.inf

    def first_due(self, time_s: Floats) -> int | None:
        """Return the index of the first sample at which a forecast is due; None without such a sample.

        A sample more than ``MAX_INTERVAL_S`` before the due time shows that the clock was set back, and is due at once.

        Args:
            time_s: Times of the samples, rejected ones included, shape (n,) [s].
        """
        earliest_s = self._due_s - MAX_INTERVAL_S
        due = np.isfinite(time_s) & ((time_s >= self._due_s) | (time_s < earliest_s))
        first = int(due.argmax()) if due.size else 0
        return first if due.size and due[first] else None

    def add(self, trace: TraceBlock, deviations: CellDeviations | None) -> None:
        """Add estimates to the observed load, and replace the deviations of the single cells."""
        self.load.add(trace)
        self.deviations = deviations

    def update(self, time_s: float) -> None:
        """Make the forecast that is due at a sample, and store it in ``latest``.

        Args:
            time_s: Time of the sample [s].
        """
        self.past.add(self.load)
        self.latest = self.forecast()
        self._due_s = time_s + _interval_s(self.latest)

    def copy(self) -> Self:
        """Return a copy in the present state, from which another thread can forecast while samples still arrive."""
        other = copy(self)
        other.estimator, other.load = self.estimator.copy(), copy(self.load)
        other.past = copy(self.past)  # its arrays are never changed in place
        other.load.record = self.load.record.copy()
        return other

    def latest_at(self, voltage_v: float, current_a: float, power_w: float) -> Forecast:
        """Return the last forecast, with each known available power raised to at least the present power.

        Args:
            voltage_v: Present voltage [V].
            current_a: Present current [A], positive on discharge.
            power_w: Present power [W], positive on discharge.
        """
        values, temperature_c = self.latest.values.copy(), float(self.estimator.record["filter"]["temperature_c"][0])
        present = PresentPower(voltage_v, current_a, power_w, temperature_c)
        raise_to_present(values, present, self._limits, self.cutoff_v)
        return replace(self.latest, values=values)

    def forecast(self, load: GivenLoad | None = None) -> Forecast:
        """Return a forecast from the present state.

        Args:
            load: Expected load; None: a load like the observed one.
        """
        values, time_s = unknown_values(), float(self.estimator.state["time_s"][0])
        # a current that the pack has already supplied or accepted is allowed, unless a configured limit is lower
        limits = self._limits.with_seen(*self.load.seen_a)
        write_capability(values, self.estimator, self.cutoff_v, limits, self._largest_a, self.deviations)
        reason = self._reason_without_state()
        if reason is None and load is None:
            reason = self._reason_without_load()
        if reason is not None:
            return Forecast(time_s, values, reason, None)
        pack = self.projected_pack(load)
        projection = self._project(pack, load)
        if projection is None:
            return Forecast(time_s, values, "the load does not discharge the pack on average", None)
        _write_time_to_cutoff(values, projection)
        if load is not None:  # write_capability has written the value at the observed load
            values["usable_capacity_ah"] = np.median(projection.charge_as) / 3600.0
        return Forecast(time_s, values, None, projection.curve)

    def given_load_curve(self, load: GivenLoad) -> ForecastCurve | None:
        """Return the curves from the present state until the end of a given load; None without a state."""
        return (
            None if self._reason_without_state() else project_until_load_end(self.projected_pack(load), load, self.seed)
        )

    def projected_pack(self, load: GivenLoad | None = None) -> Records:
        """Return the pack from which a projection starts, shape (1,), dtype ``PROJECTED_PACK``.

        It has the present state, and the resistance under the largest current of the load.

        Args:
            load: Expected load; None: a load like the observed one.
        """
        largest_a = self._largest_a if load is None else load.largest_current_a(self.cutoff_v)
        return projected_pack(self.estimator, self.cutoff_v, largest_a)

    @property
    def seed(self) -> int:
        """Seed of the random numbers, a hash of the time and the number of the last sample."""
        state = self.estimator.state
        time_bits = int(state["time_s"].view(np.uint64)[0])
        return (time_bits * _HASH_FACTOR + int(state["samples"][0])) % _SEED_COUNT

    def _reason_without_state(self) -> str | None:
        """Return the reason why the pack cannot be projected; None if it can."""
        if not self.estimator.has_filter:  # there is no state to project
            return self.estimator.cell.no_forecast_reason
        if not self.estimator.record[0]["filter"]["started"]:
            return "no sample has been processed yet"
        return None

    def _reason_without_load(self) -> str | None:
        """Return the reason why the observed load cannot represent the next one; None if it can."""
        if self.load.is_charging:
            return "the pack is being charged"
        if self.load.rest_s >= MAX_REST_S:
            return f"the pack has been at rest for {MAX_REST_S // 60} min"
        if self.load.seconds < MIN_LOAD_S:
            return f"less than {MIN_LOAD_S} s of load have been seen since the last charge"
        return None

    @property
    def _largest_a(self) -> float:
        """Largest one-second mean of the observed current [A], at least 0. Shorter inrush currents do not count."""
        return float(self.load.mean_a.max(initial=0.0))

    def _project(self, pack: Records, load: GivenLoad | None) -> Projection | None:
        """Run the pack forward. Return None if the load does not discharge it."""
        if load is not None:
            projection = project_given_load(pack, load, self.seed)
            return projection if np.isfinite(projection.time_s).all() else None
        mean_a, max_a = self.load.mean_and_max()
        current_a = mean_a - pack["offset_a"][0]
        if not discharges(pack, float(current_a.mean())):
            return None
        past_loads = self.past.analogues(mean_a.size // MINUTE_S)
        return project_observed_load(pack, mean_a, max_a, load_spread(current_a), self.seed, past_loads)


def _interval_s(forecast: Forecast) -> float:
    """Return the time until the next forecast [s]. It is shorter near the cut-off."""
    if forecast.reason is not None:
        return RETRY_S
    time_left_s = float(forecast.values["time_to_cutoff_s"][0])
    return min(max(INTERVAL_FRACTION * time_left_s, MIN_INTERVAL_S), MAX_INTERVAL_S)


def _write_time_to_cutoff(values: ForecastRows, projection: Projection) -> None:
    """Write quantiles and probabilities of the time to the cut-off."""
    time_s = projection.time_s
    for name, seconds in (("2min", 120.0), ("5min", 300.0), ("15min", 900.0)):
        values[f"cutoff_within_{name}"] = np.mean(time_s <= seconds)
    names = "time_to_cutoff_p05_s", "time_to_cutoff_s", "time_to_cutoff_p95_s"
    for name, quantile_s in zip(names, time_quantiles(time_s), strict=True):
        values[name] = quantile_s
