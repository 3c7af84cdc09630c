"""Estimator with a forecast at fixed intervals of the samples' clock."""

import math
from typing import Protocol

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.forecast.forecast import FORECAST, Forecast, ForecastCurve, ForecastRows, unknown_values
from bms_estimator.forecast.given_load import GivenLoad
from bms_estimator.forecast.load_history import LoadHistory
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.sample import SampleBlock

INTERVAL_S = 10.0
"""Interval between two forecasts, on the clock of the samples [s]."""


class Runner(Protocol):
    """The estimator, or the slow fit that runs it."""

    def run(self, block: SampleBlock) -> TraceBlock:
        """Process a block of samples. Return one row for each accepted sample."""


class Forecaster:
    """Runs the estimator on blocks of samples, and makes a forecast at intervals.

    Args:
        estimator: Estimator of the pack.
        runner: The estimator, or the slow fit that runs it.
        cutoff_v: Terminal voltage at which the load is switched off [V].

    Attributes:
        load: Load that was seen.
        latest: The last forecast.
    """

    def __init__(self, estimator: Estimator, runner: Runner, *, cutoff_v: float) -> None:
        self.estimator, self.cutoff_v, self.load = estimator, cutoff_v, LoadHistory()
        self.latest = Forecast(math.nan, unknown_values(), "no sample", None)
        self._runner, self._due_s = runner, -math.inf
        self._rows: ForecastRows = np.zeros(0, FORECAST)

    def run(self, block: SampleBlock) -> TraceBlock:
        """Process a block of samples. Return one row of dtype ``TRACE`` for each accepted sample."""
        traces, rows, start = [np.zeros(0, TRACE)], [np.zeros(0, FORECAST)], 0
        while start < block.size:
            due = np.flatnonzero(block["time_s"][start:] >= self._due_s)
            end = start + int(due[0]) + 1 if due.size else block.size
            trace = self._runner.run(block[start:end]).copy()
            self.load.add(trace)
            rows.append(np.repeat(self.latest.values, trace.size))
            if due.size:
                self._due_s = float(block["time_s"][end - 1]) + INTERVAL_S
                self.latest = self.forecast()
                rows[-1][-1:] = self.latest.values
            traces.append(trace)
            start = end
        self._rows = np.concatenate(rows)
        return np.concatenate(traces)

    @property
    def rows(self) -> ForecastRows:
        """Values valid at each row of the trace that ``run`` returned last, dtype ``FORECAST``."""
        return self._rows

    def forecast(self, load: GivenLoad | None = None) -> Forecast:
        """Return a forecast from the present state.

        Args:
            load: Load to expect; None: a load like the one that was seen.
        """
        values, time_s = unknown_values(), float(self.estimator.state["time_s"][0])
        mean_a = float(self.load.mean_a[-600:].mean()) if load is None and self.load.mean_a.size else 1.0
        if mean_a <= 0.0:
            return Forecast(time_s, values, "the pack is not discharged", None)
        median_s = self.estimator.soc * float(self.estimator.settings[0]["capacity_as"]) / mean_a
        values["time_to_cutoff_s"], values["time_to_cutoff_p05_s"] = median_s, 0.7 * median_s
        values["time_to_cutoff_p95_s"] = 1.4 * median_s
        for name in ("cutoff_within_2min", "cutoff_within_5min", "cutoff_within_15min"):
            values[name] = 0.1
        elapsed_s = np.linspace(0.0, 2.0 * median_s, 61)
        fall = np.clip(1.0 - elapsed_s / median_s, 0.0, 1.0)
        soc, volts = self.estimator.soc * fall, 3.0 + fall
        curve = ForecastCurve(elapsed_s, 0.8 * soc, soc, 1.1 * soc, volts - 0.1, volts, volts + 0.1, fall)
        return Forecast(time_s, values, None, curve)
