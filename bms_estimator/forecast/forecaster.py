"""Estimator that also makes forecasts, at intervals on the clock of the samples."""

import math
from dataclasses import replace
from typing import Protocol

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.cell_estimator import CellDeviations
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.available_power import PowerLimits, PresentPower, cell_power_limits, raise_to_present
from bms_estimator.forecast.capability import projected_pack, write_capability
from bms_estimator.forecast.forecast import FORECAST, Forecast, ForecastCurve, ForecastRows, unknown_values
from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.forecast.load_spread import load_spread
from bms_estimator.forecast.past_minutes import MINUTE_S, PastMinutes
from bms_estimator.forecast.projection import (
    Projection,
    discharges,
    project_given_load,
    project_observed_load,
    project_trip,
    time_quantiles,
)
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.arrays import Records
from bms_estimator.model.fuel_cell import FuelCellModel
from bms_estimator.model.sample import NO_CELLS, CellBlock, SampleBlock

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


class Runner(Protocol):
    """The estimator, or the slow fit that runs it."""

    def run(self, block: SampleBlock) -> TraceBlock:
        """Process a block of samples. Return one row for each accepted sample."""


class CellRunner(Protocol):
    """Estimators of the single cells."""

    @property
    def deviations(self) -> CellDeviations | None:
        """Deviations of the cells at the end of the last window; None before the first window with cell voltages."""

    def run(self, samples: SampleBlock, cells_v: CellBlock, trace: TraceBlock) -> None:
        """Process a block of samples and their cell voltages."""


class Forecaster:
    """Runs the estimator on blocks of samples, and makes a forecast at intervals.

    The times of the forecasts and their random numbers depend on the samples alone, so that any division of the samples into
    blocks gives the same forecasts to the last bit.

    Args:
        estimator: Estimator of the pack.
        runner: The estimator, or the slow fit that runs it.
        cutoff_v: Terminal voltage at which the load is switched off [V].
        limits: Limits of the available power; None: the limits of the cell file.
        cells: Estimators of the single cells, which ``run`` also runs; None: no cell voltages.

    Attributes:
        load: Load observed since the last long charge.
        past: Load of this and earlier discharges, minute by minute.
        latest: The last forecast.
    """

    def __init__(
        self,
        estimator: Estimator,
        runner: Runner,
        *,
        cutoff_v: float,
        limits: PowerLimits | None = None,
        cells: CellRunner | None = None,
    ) -> None:
        self.estimator, self.cutoff_v = estimator, cutoff_v
        self._limits = limits or cell_power_limits(estimator.cell)
        filter_settings = estimator.cell_file_settings
        self.load = LoadHistory(float(filter_settings["capacity_as"]), float(filter_settings["unmeasured_s"]))
        self.past = PastMinutes()
        self.latest = Forecast(math.nan, unknown_values(), "no sample has been processed yet", None)
        self._runner, self._cells, self._due_s = runner, cells, -math.inf
        self._has_cell_voltages, self._deviations = False, cells.deviations if cells else None
        self._rows: list[tuple[ForecastRows, int]] = []

    def run(self, block: SampleBlock, cells_v: CellBlock = NO_CELLS) -> TraceBlock:
        """Process a block of samples.

        Args:
            block: Samples, shape (n,).
            cells_v: Cell voltages of the samples, shape (n, m) [V]; empty without any.

        Returns:
            One row of dtype ``TRACE`` for each accepted sample. The array is valid until the next call.
        """
        self._rows, traces, start = [], [], 0
        while start < block.size:
            due = self._first_due(block["time_s"][start:])
            end = block.size if due is None else start + due + 1
            trace = self._runner.run(block[start:end])
            self._run_cells(block[start:end], cells_v[start:end], trace)
            self.load.add(trace)
            if start > 0 or end < block.size:
                trace = trace.copy()  # the next call of the runner overwrites the array
            traces.append(trace)
            before = trace.size if due is None else max(trace.size - 1, 0)  # rows before the new forecast
            self._rows.append((self.latest.values, before))
            if due is not None:
                self.past.add(self.load)
                self.latest = self.forecast()
                self._due_s = float(block["time_s"][end - 1]) + _interval_s(self.latest)
                self._rows.append((self.latest.values, trace.size - before))
            start = end
        if len(traces) == 1:
            return traces[0]
        return np.concatenate(traces) if traces else np.zeros(0, TRACE)

    def run_without_forecast(self, block: SampleBlock, cells_v: CellBlock = NO_CELLS) -> TraceBlock:
        """Process a block of samples and store their load, without the forecasts that ``run`` makes."""
        trace = self._runner.run(block)
        self._run_cells(block, cells_v, trace)
        self.load.add(trace)
        self.past.add(self.load)
        return trace

    def _run_cells(self, block: SampleBlock, cells_v: CellBlock, trace: TraceBlock) -> None:
        if self._cells is None:
            return
        self._has_cell_voltages |= cells_v.size > 0
        if self._has_cell_voltages:  # otherwise the call would take a tenth of the time of a block of one sample
            self._cells.run(block, cells_v, trace)
            self._deviations = self._cells.deviations

    def latest_at(self, voltage_v: float, current_a: float, power_w: float) -> Forecast:
        """Return the last forecast, in which no known available power is below the present power.

        Args:
            voltage_v: Present voltage [V].
            current_a: Present current [A], positive on discharge.
            power_w: Present power [W], positive on discharge.
        """
        values, temperature_c = self.latest.values.copy(), float(self.estimator.record["filter"]["temperature_c"][0])
        present = PresentPower(voltage_v, current_a, power_w, temperature_c)
        raise_to_present(values, present, self._limits, self.cutoff_v)
        return replace(self.latest, values=values)

    @property
    def rows(self) -> ForecastRows:
        """Values of the latest forecast at each row of the trace that ``run`` returned last, dtype ``FORECAST``."""
        parts = [np.repeat(values, count) for values, count in self._rows]
        return np.concatenate(parts) if parts else np.zeros(0, FORECAST)

    def forecast(self, load: GivenLoad | None = None) -> Forecast:
        """Return a forecast from the present state.

        Args:
            load: Expected load; None: a load like the observed one.
        """
        values, time_s = unknown_values(), float(self.estimator.state["time_s"][0])
        limits = self._limits.with_seen(*self.load.seen_a)
        write_capability(values, self.estimator, self.cutoff_v, limits, self._largest_a, self._deviations)
        reason = self._missing_state()
        if reason is None and load is None:
            reason = self._missing_load()
        if reason is not None:
            return Forecast(time_s, values, reason, None)
        pack = self.projected_pack(load)
        projection = self._project(pack, load)
        if projection is None:
            return Forecast(time_s, values, "the load does not discharge the pack on average", None)
        _write_time_to_cutoff(values, projection)
        if load is not None:
            values["usable_capacity_ah"] = np.median(projection.charge_as) / 3600.0
        return Forecast(time_s, values, None, projection.curve)

    def trip_curve(self, load: GivenLoad) -> ForecastCurve | None:
        """Return the curves from the present state until the end of a given load; None without a state."""
        return None if self._missing_state() else project_trip(self.projected_pack(load), load, self.seed)

    def projected_pack(self, load: GivenLoad | None = None) -> Records:
        """Return the present state of the pack under a load, shape (1,), dtype ``PROJECTED_PACK``.

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

    def _first_due(self, time_s: np.ndarray) -> int | None:
        """Return the index of the first sample at which a forecast is due; None without such a sample.

        A sample more than ``MAX_INTERVAL_S`` before the due time shows that the clock was set back, and is due at once.
        """
        earliest_s = self._due_s - MAX_INTERVAL_S
        due = np.isfinite(time_s) & ((time_s >= self._due_s) | (time_s < earliest_s))
        first = int(due.argmax()) if due.size else 0
        return first if due.size and due[first] else None

    def _missing_state(self) -> str | None:
        """Return the reason why the pack cannot be projected; None if it can."""
        if isinstance(self.estimator.cell, FuelCellModel):
            return "a fuel cell has no state of charge"
        if not self.estimator.identifying:
            return "the identifier is switched off"
        if not self.estimator.record[0]["filter"]["started"]:
            return "no sample has been processed yet"
        return None

    def _missing_load(self) -> str | None:
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
        """Largest mean current of a second of the observed load [A], at least 0. Shorter inrush currents do not count."""
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
        analogues = self.past.analogues(mean_a.size // MINUTE_S)
        return project_observed_load(pack, mean_a, max_a, load_spread(current_a), self.seed, analogues)


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
