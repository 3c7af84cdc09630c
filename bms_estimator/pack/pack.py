"""One pack as one object: the only place that assembles its stages and runs them in their order."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.cutoff_voltage import load_cutoff_v
from bms_estimator.estimator.estimator import TraceBlock, new_estimator
from bms_estimator.forecast.available_power import power_limits
from bms_estimator.forecast.forecast import NO_FORECAST, ForecastRows
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.kernels.trace import TRACE
from bms_estimator.model.cell import CellModel
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.model.sample import NO_CELLS, CellBlock, SampleBlock
from bms_estimator.pack_model.learning import FIT_INTERVAL_S, SlowFit, Submit, run_now
from bms_estimator.settings.pack import Settings


@dataclass(frozen=True)
class Step:
    """Result of a block of samples. The arrays are valid until the next block."""

    trace: TraceBlock
    """Estimates, one row of dtype ``TRACE`` for each accepted sample."""
    forecast_parts: tuple[tuple[ForecastRows, int], ...]
    """Values of the forecasts, and the number of rows from which on each of them was the latest; empty without forecasts."""

    @property
    def forecasts(self) -> ForecastRows:
        """Values of the latest forecast at each row of ``trace``, dtype ``FORECAST``; without forecasts a single row of NaN."""
        parts = [np.repeat(values, count) for values, count in self.forecast_parts]
        return np.concatenate(parts) if parts else NO_FORECAST


class Pack:
    """Estimator of a pack with its other stages. It owns the time: it runs each stage, and no stage runs another.

    Any division of the samples into blocks gives the same results to the last bit.

    Args:
        estimator: Estimator of the pack.
        slow_fit: Fit of the pack's model to its history; None: none.
        cells: Estimators of the single cells; None: none.
        forecaster: Forecaster; None: there are no forecasts.
        has_forecasts: False: the observed load is kept, but no forecasts are made at intervals.
    """

    def __init__(
        self,
        estimator: Estimator,
        slow_fit: SlowFit | None = None,
        cells: CellEstimator | None = None,
        forecaster: Forecaster | None = None,
        *,
        has_forecasts: bool = True,
    ) -> None:
        self.estimator, self.slow_fit, self.cells, self.forecaster = estimator, slow_fit, cells, forecaster
        self._has_forecasts = has_forecasts and forecaster is not None
        self._has_cell_voltages = False
        self._trace: TraceBlock = np.zeros(0, TRACE)

    @property
    def model(self) -> PackModel:
        """Model of the whole pack."""
        return self.estimator.cell

    def run(self, samples: SampleBlock, cells_v: CellBlock = NO_CELLS) -> Step:
        """Process a block of samples.

        Args:
            samples: Samples, shape (n,), dtype ``SAMPLE``.
            cells_v: Cell voltages of the samples, shape (n, m) [V]; empty without any.
        """
        self._has_cell_voltages |= cells_v.size > 0
        if self._trace.size < samples.size:
            self._trace = np.zeros(samples.size, TRACE)
        forecaster, forecasts, start, rows = self.forecaster, list[tuple[ForecastRows, int]](), 0, 0
        while start < samples.size:
            due = forecaster.first_due(samples["time_s"][start:]) if forecaster and self._has_forecasts else None
            end = samples.size if due is None else start + due + 1
            begin, rows = rows, self._run_estimates(samples[start:end], cells_v[start:end], rows)
            if forecaster:
                forecaster.add(self._trace[begin:rows], self.cells.deviations if self.cells else None)
            if forecaster and self._has_forecasts:
                # a due sample that is rejected marks the last accepted row
                before = rows - begin if due is None else max(rows - begin - 1, 0)
                forecasts.append((forecaster.latest.values, before))
                if due is not None:
                    forecaster.update(float(samples["time_s"][end - 1]))
                    forecasts.append((forecaster.latest.values, rows - begin - before))
            start = end
        if forecaster and not self._has_forecasts:
            forecaster.past.add(forecaster.load)
        return Step(self._trace[:rows], tuple(forecasts))

    def _run_estimates(self, samples: SampleBlock, cells_v: CellBlock, rows: int) -> int:
        """Run estimator, single cells and slow fit. Append the estimates to the trace, and return its new length.

        The single cells run before a fit is adopted, so that they see the curves in force at their samples.
        """
        start = 0
        while start < samples.size:
            used, written = self.estimator.run_part(samples[start:], self._trace[rows:])
            end, trace = start + used, self._trace[rows : rows + written]
            if self._has_cell_voltages and self.cells:  # the call would take a tenth of the time of a single sample
                self.cells.run(samples[start:end], cells_v[start:end], trace)
            if self.slow_fit:
                self.slow_fit.advance()
            start, rows = end, rows + written
        return rows


def new_pack(
    settings: Settings,
    model: PackModel,
    *,
    submit: Submit = run_now,
    on_failure: Callable[[BaseException], None] = lambda _: None,
    has_forecasts: bool = True,
) -> Pack:
    """Return a new pack, after compiling or loading the kernels of its estimator.

    A fuel cell, and a pack without the identifier, has neither slow fit nor forecasts.

    Args:
        settings: The pack's settings.
        model: Model of the whole pack.
        submit: Runs a fit; default: at once, and the samples wait for it.
        on_failure: Called with the exception of a failed fit.
        has_forecasts: False: no forecasts at intervals.

    Raises:
        UserError: The cut-off voltage is not below the voltage of the full pack.
    """
    estimator = new_estimator(settings, model)
    slow_fit = None
    if estimator.identifying and settings.identifier.pack_model:
        interval_s = settings.identifier.fit_interval_s or FIT_INTERVAL_S
        slow_fit = SlowFit(estimator, submit=submit, interval_s=interval_s, on_failure=on_failure)
    forecaster = make_forecaster(settings, model, estimator)
    return Pack(estimator, slow_fit, CellEstimator(estimator), forecaster, has_forecasts=has_forecasts)


def make_forecaster(settings: Settings, model: PackModel, estimator: Estimator) -> Forecaster | None:
    """Return the forecaster of an estimator; None for a fuel cell, and without the identifier.

    Raises:
        UserError: The cut-off voltage is not below the voltage of the full pack.
    """
    if not (estimator.identifying and isinstance(model, CellModel)):
        return None
    return Forecaster(estimator, cutoff_v=load_cutoff_v(settings, model), limits=power_limits(settings, model))
